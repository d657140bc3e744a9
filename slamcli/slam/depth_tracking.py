"""Frames and key frames placed by depth ICP, where texture ends."""

from dataclasses import dataclass
from itertools import chain

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.depth import icp
from slamcli.depth.coarse_images import CoarseImages
from slamcli.depth.icp import Alignment, OrientedPoints, PosePrior
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.parallel import LastUsed, ordered_map
from slamcli.sparse_map.sparse_map import SparseMap

LEAST_POINTS = 0.05  # share of the coarse pixels that must show a surface
KEPT = 48  # frames whose points are kept, half a megabyte each
MIN_AGREEMENT = 0.6  # of the points that meet: less, and it is another place, or the start was too far off
MIN_OVERLAP = 0.15  # of the points of a key frame, that a frame must still show
FIT_CHI2 = 50.0  # three times the 99 % quantile of six directions: the information of depth is a guess
JOIN_OVERLAP = 0.25  # that two key frames need for an edge
JOIN_M, JOIN_COSINE = 1.2, 0.6  # key frames farther apart, or turned by more, are not looked at
JOIN_MOST = 5  # edges of a new key frame to earlier ones: more of them hold down the drift of a chain


class FramePoints:
    """The oriented points of each frame of a recording; those used last are kept. Several threads may ask at once."""

    def __init__(self, images: CoarseImages, given: Camera, sensor: SensorConfig, *, camera: Camera | None = None) -> None:
        """Take the coarse depth images, read under the calibration `given`; camera : what is known of the camera, if more."""
        self._images, self._given, self._camera, self._sensor = images, given, camera or given, sensor
        self._kept: LastUsed[OrientedPoints | None] = LastUsed(KEPT)

    def under(self, camera: Camera) -> "FramePoints":
        """Return the points as another calibration of the same camera gives them."""
        return self if camera == self._camera else FramePoints(self._images, self._given, self._sensor, camera=camera)

    def of(self, frame: int) -> OrientedPoints | None:
        """Return the points of a frame, None where it shows too little."""
        return self._kept.get(frame, self._make)

    def _make(self, frame: int) -> OrientedPoints | None:
        images = self._images
        if not 0 <= frame < len(images) or not images[frame].any():
            return None
        points = icp.surface_points(images[frame], self._camera, self._sensor, given=self._given)
        return points if len(points) >= LEAST_POINTS * points.row.size else None


class NoFramePoints(FramePoints):
    """No points: the depth images of the recording are not looked at."""

    def __init__(self) -> None:
        """Take nothing."""

    def of(self, frame: int) -> None:
        """Return no points."""

    def under(self, camera: Camera) -> "NoFramePoints":
        """Return these."""
        return self


NO_FRAME_POINTS = NoFramePoints()


@dataclass(frozen=True)
class DepthPlacement:
    """Where a frame stands by depth ICP, and the evidence."""

    T_cw: np.ndarray  # (4, 4)
    kf: int  # key frame that it was aligned with
    alignment: Alignment
    n_determined: int  # of the 6 directions of motion, by depth and by the prior

    @property
    def is_sound(self) -> bool:
        """Say whether the two depth images show the same place."""
        return self.alignment.agreement >= MIN_AGREEMENT and self.alignment.overlap >= MIN_OVERLAP

    def fits(self, T_cw: np.ndarray) -> bool:
        """Say whether another pose of the frame contradicts nothing that depth says."""
        e = se3.log(product(T_cw, se3.inverse(self.T_cw)))
        return bool(product(e, self.alignment.information, e) < FIT_CHI2)


class DepthAligner:
    """Places frames by aligning their depth images with those of key frames."""

    def __init__(self, sparse_map: SparseMap, map_frame_points: FramePoints, frame_points: FramePoints) -> None:
        """Take the map with the points of the recording it is of, and those of the recording whose frames are placed."""
        self._sparse_map, self._map_frame_points, self._frame_points = sparse_map, map_frame_points, frame_points

    def place(self, frame: int, kf: int, starts: list[np.ndarray], prior: PosePrior | None = None) -> DepthPlacement | None:
        """Align a frame with key frame `kf` from the first of the poses `starts` (T_cw) that leads to a sound placement.

        The key frame's points are moved onto the frame's, so that T_ij of `icp.align` is T_ck. None where depth is missing.
        prior : of T_cw
        """
        target, source = self._frame_points.of(frame), self._map_frame_points.of(int(self._sparse_map.kf.frame[kf]))
        if target is None or source is None:
            return None
        T_wk = self._sparse_map.kf.T_wk[kf]
        relative = None if prior is None else PosePrior(product(prior.T, T_wk), prior.information)
        placement = None
        for T_cw in starts:
            found = icp.align(product(T_cw, T_wk), source, target, prior=relative)
            information = found.information + (0.0 if prior is None else prior.information)
            candidate = DepthPlacement(product(found.T_ij, se3.inverse(T_wk)), kf, found, icp.n_determined(information, found.depth))
            if placement is None or candidate.alignment.agreement > placement.alignment.agreement:
                placement = candidate
            if placement.is_sound:
                break
        return placement

    def has_depth(self, frame: int) -> bool:
        """Say whether a frame's depth image shows enough to be aligned."""
        return self._frame_points.of(frame) is not None

    def fixes_all(self, frame: int) -> bool:
        """Say whether the surfaces that a frame shows determine all directions of motion, so that a map can begin with it."""
        # Not by itself: the errors of its normals would agree, and a wall would seem rough.
        here, there = self._frame_points.of(frame), self._frame_points.of(frame + 1) or self._frame_points.of(frame - 1)
        if here is None or there is None:
            return False
        found = icp.align(np.eye(4), here, there)
        return found.agreement >= MIN_AGREEMENT and icp.n_determined(found.information, found.depth) == icp.DIRECTIONS

    def add_edges(self, kf: int) -> int:
        """Add edges between a key frame and the earlier ones around that show the same; returns how many."""
        n = 0
        table = self._sparse_map.kf
        around = self.around(table.T_wk[kf], int(table.segment[kf]))
        for other in around[around < kf]:
            n += self.add_edge(kf, int(other))
            if n == JOIN_MOST:
                break
        return n

    def add_covisible_edges(self, T_cd: np.ndarray, *, most: int, least: int, workers: int = 1) -> int:
        """Add edges between each key frame and up to `most` earlier ones that share at least `least` landmarks; returns how many.

        T_cd : (K, 4, 4) each key frame's camera when its depth was measured, to its camera when colour was; workers : threads
        """
        joined = set(map(tuple, self._sparse_map.edge.kf.tolist()))

        def edges(kf: int) -> list[tuple | None]:
            neighbours, shared = self._sparse_map.covisible(kf)
            others = neighbours[(neighbours < kf) & (shared >= least)][:most].tolist()
            return [self._edge(kf, other, T_cd) for other in others if (kf, other) not in joined]

        found = chain.from_iterable(ordered_map(edges, range(1, len(self._sparse_map.kf)), workers=workers))
        return sum(self._add(edge) for edge in list(found))

    def add_edge(self, kf_i: int, kf_j: int, T_cd: np.ndarray | None = None) -> bool:
        """Add an edge between two key frames if their depth images show the same and determine how the two lie."""
        return self._add(self._edge(kf_i, kf_j, T_cd))

    def _edge(self, kf_i: int, kf_j: int, T_cd: np.ndarray | None) -> tuple[int, int, np.ndarray, np.ndarray] | None:
        """Find the edge between two key frames, as `SparseMap.add_edge` takes it; None where their depth images determine none."""
        table = self._sparse_map.kf
        T_i, T_j = (np.eye(4) if T_cd is None else T_cd[kf] for kf in (kf_i, kf_j))
        target, source = (self._map_frame_points.of(int(table.frame[kf])) for kf in (kf_i, kf_j))
        if target is None or source is None:
            return None
        found = icp.align(product(se3.inverse(product(table.T_wk[kf_i], T_i)), table.T_wk[kf_j], T_j), source, target)
        if (
            found.agreement < MIN_AGREEMENT
            or found.overlap < JOIN_OVERLAP
            or icp.n_determined(found.information, found.depth) < icp.DIRECTIONS
        ):
            return None
        to_depth = se3.adjoint(se3.inverse(T_i))
        return kf_i, kf_j, product(T_i, found.T_ij, se3.inverse(T_j)), product(to_depth.T, found.information, to_depth)

    def _add(self, edge: tuple[int, int, np.ndarray, np.ndarray] | None) -> bool:
        if edge is not None:
            self._sparse_map.add_edge(*edge)
        return edge is not None

    def around(self, T_wc: np.ndarray, segment: int) -> np.ndarray:
        """Return the key frames of a segment that stand and look nearly as a camera at T_wc does, nearest first."""
        table = self._sparse_map.kf
        apart = np.linalg.norm(table.T_wk[:, :3, 3] - T_wc[:3, 3], axis=1)
        cosine = product(table.T_wk[:, :3, 2], T_wc[:3, 2])
        near = np.flatnonzero((table.segment == segment) & (apart < JOIN_M) & (cosine > JOIN_COSINE))
        return near[np.argsort(apart[near] + (1.0 - cosine[near]), kind="stable")]
