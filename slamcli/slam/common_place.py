"""Whether two parts of a map can be one place: what both of them saw must be the same, in shape and in picture.

Several closures that agree are not enough to join recordings of different houses: makers repeat doors, posters and furniture, and such
things stand in the same way to each other wherever they are. But under a wrong placement much of what one recording shows lies in space
that the other looks through, and views from nearly the same spot show different pictures. Two corridors of equal doors differ at their ends
alone, which few of the views show: so pictures are compared place by place, too.

Within a recording, odometry speaks against a wrong place, but less and less the longer the way between: along a corridor of equal doors it
does not tell one from the next. So a closure that moves its view far has the views around it compared in the same way.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamcli.config.options import LoopConfig
from slamcli.depth import icp
from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry import depth_noise, se3
from slamcli.geometry.algebra import product
from slamcli.slam import depth_views
from slamcli.slam import moving_object_kernels as kernels
from slamcli.slam.depth_views import Views
from slamcli.slam.loop_candidates import Candidate
from slamcli.slam.loop_verification import MAX_DISTANCE, RATIO, WIDENINGS, find_again
from slamcli.slam.map_merging import Join
from slamcli.sparse_map import guided_matching, landmark_pose
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.guided_matching import SearchLimits
from slamcli.sparse_map.sparse_map import SparseMap

AHEAD = 2.0  # [m] before a camera, what it looks at
OVERLAP = 2.0  # [m] between what two views look at, that may show the same
VIEWS = 6  # of the other segment, nearest first, that each key frame is compared with
NEAR_M, NEAR_COSINE = 0.5, 0.94  # apart, views whose pictures must be alike
MOST_PAIRS = 60  # of these, evenly spread, are compared
LEAST_AGREEMENT = 0.8  # of the surface that both saw
MOST_DIFFERENT = 0.5  # of the pairs of near views
PLACE = 1.0  # [m] side of the cubes that pictures are compared in
LEAST_EXPECTED = 100  # landmarks that views of a place should show, before it says anything
# Share of these that is found, beside the share over all places. Of one room, the least alike had 0.39 of it; of two corridors that differ
# at their ends, two places or more of some thirteen had 0 to 0.2. One such place is no objection: a picture on a wall may have been changed.
# Nor are a few of many: in another light, a floor whose picture is burnt out had 0.08 to 0.2 at 7 of the 171 places of a building.
OTHERWISE, MOST_OTHERWISE, MOST_SHARE = 0.2, 1, 0.05
WINDOW = 25  # key frames before and after each side of a closure, that are compared
MOVED_M, MOVED_RAD = 0.3, 0.1  # a closure that moves its view by less is one of a place that odometry knows


@dataclass(frozen=True)
class Comparison:
    """What two segments say of one another under a placement."""

    n_pairs: int = 0  # pairs of views from nearly the same spot
    n_different: int = 0  # of these, pairs in which one does not show the landmarks of the other, counted until it is decided
    n_places: int = 0  # whose surface both saw,
    n_otherwise: int = 0  # but hardly one landmark of the other
    agreement: float = 1.0  # share of the surface that the other segment sees again, of that which it sees again or looks through

    @property
    def objection(self) -> str:
        """Say why the two cannot be one place, "" when they can."""
        if self.n_different > MOST_DIFFERENT * self.n_pairs:
            return f"more than {MOST_DIFFERENT:.0%} of {self.n_pairs} pairs of views from nearly one spot show different things"
        if self.n_otherwise > max(MOST_OTHERWISE, MOST_SHARE * self.n_places):
            return (
                f"{self.n_otherwise} of {self.n_places} places of {PLACE:g} m look different from the two sides, "
                "though their surfaces would be the same"
            )
        if not self.agreement >= LEAST_AGREEMENT:
            return f"one side looks through {1.0 - self.agreement:.0%} of what would be one surface"
        return ""


def count_otherwise(place: np.ndarray, is_found: np.ndarray) -> tuple[int, int]:
    """Count the places, and those at which hardly any of the landmarks that should be seen were found, beside the share found everywhere.

    place : (N, 3) whole numbers, of each landmark that a view should show; is_found : (N,) bool
    """
    if not len(place):
        return 0, 0
    _, at = np.unique(place, axis=0, return_inverse=True)
    n_expected, n_found = np.bincount(at.ravel()), np.bincount(at.ravel(), weights=is_found)
    share = float(np.mean(is_found))
    is_place = n_expected >= LEAST_EXPECTED
    return int(is_place.sum()), int((is_place & (n_found < OTHERWISE * share * n_expected)).sum())


class Jury:
    """Judges placements of the segments of a map."""

    def __init__(self, sparse_map: SparseMap, depth: CoarseImages, frames: FrameStore, settings: LoopConfig) -> None:
        """Take the map, and the frames of the recording that it is of with their coarse depth images."""
        self._sparse_map, self._depth, self._frames, self._settings = sparse_map, depth, frames, settings

    def objection(self, found: Join) -> str:
        """Say why two segments cannot be one place under a placement, "" when they can."""
        return self.weigh(found).objection

    def weigh(self, found: Join) -> Comparison:
        """Compare the views of two segments under a placement of one to the other."""
        segment = self._sparse_map.kf.segment
        return self._weigh(np.flatnonzero(segment == found.a), np.flatnonzero(segment == found.b), found.T_ab)

    def objection_to_closure(self, closure: Candidate) -> str:
        """Say why the two sides of a verified closure within a segment cannot be one place.

        Returns "" when they can, or when the closure moves its view little.
        """
        assert closure.T_ij is not None, "only a verified closure has a pose"
        kf, i, j = self._sparse_map.kf, closure.kf_i, closure.kf_j
        T_wi = product(kf.T_wk[j], se3.inverse(closure.T_ij))
        move = product(T_wi, se3.inverse(kf.T_wk[i]))
        moved = se3.log(product(se3.inverse(kf.T_wk[i]), T_wi))
        if np.linalg.norm(moved[:3], axis=-1) < MOVED_M and np.linalg.norm(moved[3:], axis=-1) < MOVED_RAD:
            return ""
        reach = min(WINDOW, (i - j) // 2)
        rows = np.flatnonzero(kf.segment == kf.segment[i])
        a, b = (rows[np.abs(rows - side) <= reach] for side in (j, i))
        return self._weigh(a, b[b > a[-1]], move).objection

    def _weigh(self, a: np.ndarray, b: np.ndarray, T_ab: np.ndarray) -> Comparison:
        """Compare the views of key frames b, moved by T_ab, with those of key frames a, until something speaks against the motion.

        What costs least and speaks most often comes first.
        """
        T_ak = np.array(self._sparse_map.kf.T_wk)
        T_ak[b] = product(T_ab, T_ak[b])
        pairs = self._near_pairs(T_ak, a, b)
        comparison = Comparison(len(pairs), self._count_different(T_ak, pairs))
        if not comparison.objection:
            looks = [(pair, np.eye(4)) for pair in pairs] + [(pair, T_ab) for pair in self._near_pairs(T_ak, b, a)]
            n_places, n_otherwise = self._otherwise(T_ak, looks)
            comparison = replace(comparison, n_places=n_places, n_otherwise=n_otherwise)
        if not comparison.objection:
            comparison = replace(comparison, agreement=self._agreement(T_ak, a, b))
        return comparison

    def _agreement(self, T_ak: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
        spot = T_ak[:, :3, 3] + AHEAD * T_ak[:, :3, 2]
        apart = np.linalg.norm(spot[b][:, None] - spot[a], axis=2)
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
                    z, seen = depth_views.seen_from(views, int(frame[view]), frame[others])
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

    def _count_different(self, T_ak: np.ndarray, pairs: list[tuple[int, int]]) -> int:
        """Count the pairs of views that show different things, until it is decided whether these are too many."""
        n_different, most = 0, MOST_DIFFERENT * len(pairs)
        for n_seen, pair in enumerate(pairs):
            if n_different > most or n_different + len(pairs) - n_seen <= most:
                break
            n_different += not self._are_alike(T_ak, *pair)
        return n_different

    def _are_alike(self, T_ak: np.ndarray, i: int, j: int) -> bool:
        T_ia = se3.inverse(T_ak[i])  # j stands in the world of a already
        return find_again(self._sparse_map, Candidate(i, j, 0.0), T_ia, self._frames, self._settings).is_accepted

    def _otherwise(self, T_ak: np.ndarray, looks: list[tuple[tuple[int, int], np.ndarray]]) -> tuple[int, int]:
        """Count the places of which near views show the same surface, and those of which they show other landmarks.

        looks : key frames (i, j) of different parts, and the motion (4, 4) of the world that j stands in to that of part a
        """
        places, finds = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=bool)]
        for (i, j), T_aj in looks:
            x_a, is_expected, is_found = self._looked_for(T_ak, i, j, T_aj)
            places.append(np.floor(x_a[is_expected] / PLACE).astype(np.int64))
            finds.append(is_found[is_expected])
        return count_otherwise(np.concatenate(places), np.concatenate(finds))

    def _looked_for(self, T_ak: np.ndarray, i: int, j: int, T_aj: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Look in key frame i for the landmarks that key frame j shows.

        Returns the landmarks (N, 3) in the world of part a, whether i should show each, having its surface in view, and whether it does.
        """
        kf = self._sparse_map.kf
        landmarks = self._sparse_map.landmarks(self._sparse_map.landmarks_of(j))
        frame = self._frames[int(kf.frame[i])]
        limits = SearchLimits(self._settings.search_radius_px, MAX_DISTANCE, RATIO)
        T_iw, wanted = product(se3.inverse(T_ak[i]), T_aj), self._settings.min_inliers
        shown = landmark_pose.find(T_iw, landmarks, frame, limits.widened(WIDENINGS[-1]), wanted=wanted)
        if shown.estimate is not None:  # from the pose that the first look gives, a narrow window tells more
            T_iw = shown.estimate.T_cw
            shown = landmark_pose.find(T_iw, landmarks, frame, limits, wanted=wanted)
        is_found = np.zeros(len(landmarks.xyz), dtype=bool)
        is_found[shown.landmark] = True
        is_expected = shown.is_visible & self._shows_surface(int(kf.frame[i]), se3.transform(T_iw, landmarks.xyz))
        return se3.transform(T_aj, landmarks.xyz), is_expected, is_found

    def _shows_surface(self, frame: int, x_c: np.ndarray) -> np.ndarray:
        """Say at which of the points (N, 3) [m], in the frame's camera, its depth image shows a surface."""
        small, row_at = icp.coarse_camera(self._frames.camera)
        raw = np.append(self._depth[frame].ravel(), np.uint16(0))
        depth = raw[np.where(row_at < small.width * small.height, row_at, -1)] * icp.UNIT  # -1 takes the 0 at the end
        z = np.maximum(x_c[:, 2], guided_matching.NEAREST)
        u, v = np.rint(np.column_stack([x_c[:, 0] / z * small.fx + small.cx, x_c[:, 1] / z * small.fy + small.cy])).astype(np.int64).T
        is_in = (u >= 0) & (u < small.width) & (v >= 0) & (v < small.height)
        there = np.where(is_in, depth[v.clip(0, small.height - 1), u.clip(0, small.width - 1)], 0.0)
        base, share, growth = depth_views.TOLERANCE
        return (there > 0.0) & (np.abs(there - z) < base + share * z + growth * np.maximum(z - depth_noise.BEST, 0.0) ** 2)
