"""Candidates for a loop: pairs of key frames that may show the same place, by their words or by their poses."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from slamcli.config.options import LoopConfig
from slamcli.geometry.algebra import product
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.sparse_map.sparse_map import SparseMap

AHEAD = 2.0  # [m] before the camera, what it looks at
MIN_COSINE = 0.7  # between the directions of two views of one spot


@dataclass(frozen=True)
class Candidate:
    """Two key frames that may show the same place, and what verification made of them."""

    kf_i: int
    kf_j: int
    score: float  # similarity of the word vectors, [Z] (10)
    n_matches: int = 0  # features under the same vocabulary node
    n_inliers: int = 0  # landmarks around j found in i
    reason: str = ""  # why it was rejected; empty = accepted
    T_ij: np.ndarray | None = None
    is_by_pose: bool = False  # proposed by the poses of the two, not by their words

    @property
    def is_accepted(self) -> bool:
        """Say whether the place was verified."""
        return not self.reason

    def rejected(self, reason: str) -> "Candidate":
        """Return the candidate as rejected."""
        return replace(self, reason=reason)


def find_alike(sparse_map: SparseMap, places: PlaceIndex, settings: LoopConfig) -> list[Candidate]:
    """List pairs of key frames whose bags of words are alike but which are not covisible, most alike first."""
    candidates = []
    for i in range(len(sparse_map.kf)):
        scores = places.scores(i)
        shared = sparse_map.votes(sparse_map.landmarks_of(i))
        # Each vocabulary has its own range of scores: a place seen again should score a share of what the neighbours do in the mean.
        # [ORB-SLAM] takes the least of theirs.
        neighbours = np.flatnonzero(shared >= settings.min_shared)
        neighbours = neighbours[neighbours != i]
        least = (
            settings.min_score if len(neighbours) == 0 else min(settings.min_score, settings.score_share * float(scores[neighbours].mean()))
        )
        scores[shared >= settings.min_shared] = 0.0
        scores[i:] = 0.0
        for j in np.argsort(-scores, kind="stable")[: settings.candidates]:
            if scores[j] >= least and scores[j] > 0.0:
                candidates.append(Candidate(i, int(j), float(scores[j])))
    return sorted(candidates, key=lambda c: (-c.score, c.kf_i, c.kf_j))


def find_by_pose(sparse_map: SparseMap, places: PlaceIndex, settings: LoopConfig) -> list[Candidate]:
    """List pairs of key frames that view the same place according to their current poses but are not covisible, sorted by distance.

    Words miss such pairs when little of the two views is in common, as on either side of a gap, or when both are seen at an angle.
    """
    candidates = []
    spot = sparse_map.kf.T_wk[:, :3, 3] + AHEAD * sparse_map.kf.T_wk[:, :3, 2]
    for i in range(1, len(sparse_map.kf)):
        is_open = sparse_map.votes(sparse_map.landmarks_of(i))[:i] < settings.min_shared
        is_open &= sparse_map.kf.segment[:i] == sparse_map.kf.segment[i]
        is_open &= product(sparse_map.kf.T_wk[:i, :3, 2], sparse_map.kf.T_wk[i, :3, 2]) > MIN_COSINE
        apart = np.where(is_open, np.linalg.norm(spot[:i] - spot[i], axis=1), np.inf)
        j = int(np.argmin(apart))
        if apart[j] < settings.near:
            candidates.append((float(apart[j]), Candidate(i, j, float(places.scores(i)[j]), is_by_pose=True)))
    return [c for _, c in sorted(candidates, key=lambda pair: (pair[0], pair[1].kf_i))]


def is_same_revisit(a: Candidate, b: Candidate, *, span: int) -> bool:
    """Say whether two candidates claim the same revisit."""
    return abs(a.kf_i - b.kf_i) <= span and abs(a.kf_j - b.kf_j) <= span


class Claims:
    """Claims of revisits so far; a candidate is compared only with those in the cells around it."""

    def __init__(self, candidates: Iterable[Candidate], *, span: int) -> None:
        """Take the first claims; span : key frames that one claim covers to either side, see `is_same_revisit`."""
        self._span = span
        self._cells: dict[tuple[int, int], list[Candidate]] = {}
        for c in candidates:
            self.add(c)

    def add(self, c: Candidate) -> None:
        """Note one more claim."""
        self._cells.setdefault(self._cell(c), []).append(c)

    def cover(self, c: Candidate) -> bool:
        """Say whether a candidate claims the same revisit as any of them."""
        i, j = self._cell(c)
        around = (self._cells.get((i + down, j + right), ()) for down in (-1, 0, 1) for right in (-1, 0, 1))
        return any(is_same_revisit(c, other, span=self._span) for cell in around for other in cell)

    def _cell(self, c: Candidate) -> tuple[int, int]:
        return c.kf_i // (self._span + 1), c.kf_j // (self._span + 1)


def first_of_each_revisit(candidates: list[Candidate], *, span: int) -> list[Candidate]:
    """Keep the first of those that claim the same revisit."""
    kept, claims = [], Claims((), span=span)
    for c in candidates:
        if not claims.cover(c):
            kept.append(c)
            claims.add(c)
    return kept
