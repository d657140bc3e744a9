"""Map merging: two segments of a map that saw the same place are joined."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.slam import loop_pose_graph
from slamcli.slam.loop_candidates import Candidate
from slamcli.sparse_map.sparse_map import SparseMap

AGREE_M, AGREE_RAD = 0.1, 0.05  # closures that differ by less agree on how two segments lie
OUTWEIGH = 2.0  # times the landmarks of any others that agree on something else


@dataclass(frozen=True)
class Join:
    """Two segments and the closures that agree on how they lie."""

    a: int
    b: int
    T_ab: np.ndarray  # (4, 4) world of segment b to that of a
    closures: list[Candidate]
    support: int  # landmarks that the closures found again


def find_join(sparse_map: SparseMap, closures: list[Candidate], *, least: int, refused: Sequence[Join] = ()) -> Join | None:
    """Find the two segments for which the most speaks; None where fewer than `least` closures agree on how two segments lie.

    closures : verified, each between two segments
    refused : joins that cannot be, with closures of their own: they show that these places repeat themselves, and speak against any
        other placement of the same two segments

    One closure between segments stands alone: no odometry runs between them that could contradict it. So several have to say the same,
    and no others that say otherwise may come near them in weight, as they do where places look alike.
    """
    segment = sparse_map.kf.segment
    pairs = sorted({tuple(sorted((int(segment[c.kf_i]), int(segment[c.kf_j])))) for c in closures})
    found = [_between(sparse_map, closures, a, b, _support_of_refused(sparse_map, refused, a, b)) for a, b in pairs]
    return max((j for j in found if j is not None and len(j.closures) >= least), key=lambda j: j.support, default=None)


def _support_of_refused(sparse_map: SparseMap, refused: Sequence[Join], a: int, b: int) -> int:
    """Return the support of the strongest refused join between what now are segments a and b."""
    segment = sparse_map.kf.segment
    between = (join for join in refused if {int(segment[kf]) for c in join.closures for kf in (c.kf_i, c.kf_j)} == {a, b})
    return max((join.support for join in between), default=0)


def _between(sparse_map: SparseMap, closures: list[Candidate], a: int, b: int, rival_before: int) -> Join | None:
    """Find what most closures between segments a and b say of how they lie; None where others contradict them."""
    segment = sparse_map.kf.segment
    here = [c for c in closures if {int(segment[c.kf_i]), int(segment[c.kf_j])} == {a, b}]
    between = [c if segment[c.kf_i] == a else _turned(c) for c in here]
    T_wi, T_wj, T_ij = (
        np.array(T) for T in zip(*((sparse_map.kf.T_wk[c.kf_i], sparse_map.kf.T_wk[c.kf_j], c.T_ij) for c in between), strict=True)
    )
    T_ab = product(T_wi, T_ij, se3.inverse(T_wj))
    # residual of closure n under the hypothesis of closure m, (m, n, 6)
    e = se3.log(product(se3.inverse(T_wi), T_ab[:, None], T_wj, se3.inverse(T_ij)))
    agrees = (np.linalg.norm(e[..., :3], axis=-1) < AGREE_M) & (np.linalg.norm(e[..., 3:], axis=-1) < AGREE_RAD)
    weight = np.array([c.n_inliers for c in between])
    m = int(np.argmax(product(agrees, weight)))
    support, rival = int(product(agrees[m], weight)), int((product(agrees & ~agrees[m], weight))[~agrees[m]].max(initial=0))
    if support < OUTWEIGH * max(rival, rival_before):
        return None
    return Join(a, b, T_ab[m], [c for c, is_one in zip(here, agrees[m], strict=True) if is_one], support)


def _turned(c: Candidate) -> Candidate:
    """Return a closure as seen from its other key frame."""
    assert c.T_ij is not None, "an accepted closure has a pose"
    return replace(c, kf_i=c.kf_j, kf_j=c.kf_i, T_ij=se3.inverse(c.T_ij))


def join(sparse_map: SparseMap, found: Join) -> None:
    """Move segment b, with its landmarks, into the world of a."""
    is_b = sparse_map.kf.segment == found.b
    T_wk = sparse_map.kf.T_wk.copy()
    T_wk[is_b] = product(found.T_ab, T_wk[is_b])
    loop_pose_graph.move(sparse_map, T_wk)
    sparse_map.kf.segment[is_b] = found.a
