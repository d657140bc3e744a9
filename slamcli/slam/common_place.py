"""Whether two map segments can be one place: what both of them saw must be the same, in shape and in picture.

Several closures that agree are not enough to join recordings of different houses: makers repeat doors, posters and furniture, and such
things stand in the same way to each other wherever they are. But under a wrong placement much of what one recording shows lies in space
that the other looks through, and views from nearly the same spot show different pictures.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import LoopConfig
from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.slam import moving_object_kernels as kernels
from slamcli.slam import moving_objects
from slamcli.slam.loop_candidates import Candidate
from slamcli.slam.loop_verification import find_again
from slamcli.slam.map_merging import Join
from slamcli.slam.moving_objects import Views
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap

AHEAD = 2.0  # [m] before a camera, what it looks at
OVERLAP = 2.0  # [m] between what two views look at, that may show the same
VIEWS = 6  # of the other segment, nearest first, that each key frame is compared with
NEAR_M, NEAR_COSINE = 0.5, 0.94  # apart, views whose pictures must be alike
MOST_PAIRS = 60  # of these, evenly spread, are compared
LEAST_AGREEMENT = 0.8  # of the surface that both saw
LEAST_ALIKE = 0.5  # of the pairs of near views


@dataclass(frozen=True)
class Evidence:
    """What two segments say of one another under a placement."""

    agreement: float  # share of the surface that the other segment sees again, of that which it sees again or looks through
    n_pairs: int  # pairs of views from nearly the same spot
    n_alike: int  # of these, pairs in which one shows the landmarks of the other

    @property
    def objection(self) -> str:
        """Say why the two cannot be one place, "" when they can."""
        if not self.agreement >= LEAST_AGREEMENT:
            return f"the other recording looks through {1.0 - self.agreement:.0%} of what would be one surface"
        if self.n_alike < LEAST_ALIKE * self.n_pairs:
            return f"{self.n_pairs - self.n_alike} of {self.n_pairs} pairs of views from nearly one spot show different things"
        return ""


class Jury:
    """Judges placements of the segments of a map."""

    def __init__(self, sparse_map: SparseMap, depth: CoarseImages, frames: FrameStore, settings: LoopConfig) -> None:
        """Take the map, and the frames of the recording that it is of with their coarse depth images."""
        self._sparse_map, self._depth, self._frames, self._settings = sparse_map, depth, frames, settings

    def objection(self, found: Join) -> str:
        """Say why two segments cannot be one place under a placement, "" when they can."""
        return self.weigh(found).objection

    def weigh(self, found: Join) -> Evidence:
        """Compare the views of two segments under a placement of one to the other."""
        kf = self._sparse_map.kf
        a, b = (np.flatnonzero(kf.segment == segment) for segment in (found.a, found.b))
        T_ak = np.array(kf.T_wk)
        T_ak[b] = product(found.T_ab, T_ak[b])
        spot = T_ak[:, :3, 3] + AHEAD * T_ak[:, :3, 2]
        apart = np.linalg.norm(spot[b][:, None] - spot[a], axis=2)
        agreement = self._agreement(T_ak, a, b, apart)
        pairs = self._near_pairs(T_ak, a, b)
        return Evidence(agreement, len(pairs), sum(self._are_alike(T_ak, *pair) for pair in pairs))

    def _agreement(self, T_ak: np.ndarray, a: np.ndarray, b: np.ndarray, apart: np.ndarray) -> float:
        n, frame = len(self._depth), self._sparse_map.kf.frame
        T_wc = np.full((n, 4, 4), np.nan)
        T_wc[frame] = T_ak
        views = Views(self._depth, np.zeros(n), T_wc, np.zeros(n, dtype=np.int64), self._frames.camera)
        again = through = 0.0
        for here, there, between in ((b, a, apart), (a, b, apart.T)):
            for row, view in enumerate(here.tolist()):
                order = np.argsort(between[row], kind="stable")[:VIEWS]
                others = there[order[between[row, order] < OVERLAP]]
                if len(others):
                    z, seen = moving_objects.seen_from(views, int(frame[view]), frame[others])
                    again += float((z * z * (seen == kernels.AGAIN)).sum())
                    through += float((z * z * (seen == kernels.THROUGH)).sum())
        return again / (again + through) if again + through > 0.0 else 1.0

    def _near_pairs(self, T_ak: np.ndarray, a: np.ndarray, b: np.ndarray) -> list[tuple[int, int]]:
        """List pairs of key frames (of b, of a) that look at the same from nearly the same spot, each of b with the nearest."""
        centre, ahead = T_ak[:, :3, 3], T_ak[:, :3, 2]
        apart = np.linalg.norm(centre[b][:, None] - centre[a], axis=2)
        apart[product(ahead[b], ahead[a].T) < NEAR_COSINE] = np.inf
        nearest = apart.argmin(axis=1)
        pairs = [(int(b[row]), int(a[nearest[row]])) for row in np.flatnonzero(apart.min(axis=1) < NEAR_M)]
        return pairs if len(pairs) <= MOST_PAIRS else [pairs[k] for k in np.linspace(0, len(pairs) - 1, MOST_PAIRS).astype(int)]

    def _are_alike(self, T_ak: np.ndarray, i: int, j: int) -> bool:
        T_ia = se3.inverse(T_ak[i])  # j stands in the world of a already
        return find_again(self._sparse_map, Candidate(i, j, 0.0), T_ia, self._frames, self._settings).is_accepted
