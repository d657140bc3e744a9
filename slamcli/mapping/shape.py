"""Frames and key frames placed by the shape that their depth images show, where texture ends."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from slamcli.config import SensorConfig
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.mapping import surface
from slamcli.mapping.mapbuilder import MapBuilder
from slamcli.mapping.surface import Alignment, Relief
from slamcli.schema import CoarseDepth

LEAST_POINTS = 0.05  # share of the coarse pixels that must show a surface
KEPT = 48  # reliefs, of half a megabyte each
MIN_AGREEMENT = 0.6  # of the points that meet: less, and it is another place, or the start was too far off
MIN_OVERLAP = 0.15  # of the points of a key frame, that a frame must still show
JOIN_OVERLAP = 0.25  # that two key frames need for an edge
JOIN_M, JOIN_COSINE = 1.2, 0.6  # key frames farther apart, or turned by more, are not looked at
JOIN_MOST = 5  # edges of a new key frame to earlier ones: more of them hold down the drift of a chain


class Reliefs:
    """The reliefs of a recording's frames; those used last are kept."""

    def __init__(self, depth: CoarseDepth, camera: Camera, sensor: SensorConfig) -> None:
        self._depth, self._camera, self._sensor = depth.coarse_depth, camera, sensor
        self._kept: OrderedDict[int, Relief | None] = OrderedDict()

    def of(self, frame: int) -> Relief | None:
        """Give the relief of a frame, None where it shows too little."""
        if frame in self._kept:
            self._kept.move_to_end(frame)
            return self._kept[frame]
        self._kept[frame] = found = self._make(frame)
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return found

    def _make(self, frame: int) -> Relief | None:
        if not 0 <= frame < len(self._depth) or not self._depth[frame].any():
            return None
        relief = surface.relief(self._depth[frame], self._camera, self._sensor)
        return relief if len(relief) >= LEAST_POINTS * relief.row.size else None


class NoReliefs(Reliefs):
    """Of a recording whose depth images are not looked at."""

    def __init__(self) -> None:
        """Take nothing."""

    def of(self, frame: int) -> None:
        """Give no relief."""


@dataclass(frozen=True)
class Placement:
    """Where a frame stands by shape, and the evidence."""

    T_cw: np.ndarray  # (4, 4)
    kf: int  # key frame that it was aligned with
    alignment: Alignment
    n_determined: int  # of the 6 directions of motion, by shape and by what was known besides

    @property
    def is_sound(self) -> bool:
        """Say whether the two depth images show the same place."""
        return self.alignment.agreement >= MIN_AGREEMENT and self.alignment.overlap >= MIN_OVERLAP


class Shape:
    """Places frames by aligning their depth images with those of key frames."""

    def __init__(self, builder: MapBuilder, map_reliefs: Reliefs, reliefs: Reliefs) -> None:
        """Take the map with the reliefs of the recording it is of, and those of the recording whose frames are placed."""
        self._builder, self._map_reliefs, self._reliefs = builder, map_reliefs, reliefs

    def place(self, frame: int, kf: int, starts: list[np.ndarray], known: tuple[np.ndarray, np.ndarray] | None = None) -> Placement | None:
        """Align a frame with key frame `kf` from the first of the poses `starts` (T_cw) that leads to a sound placement.

        known : a pose T_cw (4, 4) and the information (6, 6) of its left twist, as landmarks give. None where depth is missing.
        """
        target, source = self._reliefs.of(frame), self._map_reliefs.of(int(self._builder.kf.frame[kf]))
        if target is None or source is None:
            return None
        T_wk = self._builder.kf.T_wk[kf]
        besides = None if known is None else (known[0] @ T_wk, known[1])
        placement = None
        for T_cw in starts:
            found = surface.align(T_cw @ T_wk, source, target, known=besides)
            information = found.information + (0.0 if known is None else known[1])
            candidate = Placement(found.T_ij @ se3.inverse(T_wk), kf, found, surface.n_determined(information, found.depth))
            if placement is None or candidate.alignment.agreement > placement.alignment.agreement:
                placement = candidate
            if placement.is_sound:
                break
        return placement

    def fixes_all(self, frame: int) -> bool:
        """Say whether the shape that a frame shows determines all directions of motion, so that a map can begin with it."""
        # Not by itself: the errors of its normals would agree, and a wall would seem rough.
        here, there = self._reliefs.of(frame), self._reliefs.of(frame + 1) or self._reliefs.of(frame - 1)
        if here is None or there is None:
            return False
        found = surface.align(np.eye(4), here, there)
        return found.agreement >= MIN_AGREEMENT and surface.n_determined(found.information, found.depth) == 6

    def join(self, kf: int) -> int:
        """Add edges between a key frame and the earlier ones around that show the same; returns how many."""
        n = 0
        for other in self._around(kf):
            n += self.join_pair(kf, int(other))
            if n == JOIN_MOST:
                break
        return n

    def join_pair(self, kf_i: int, kf_j: int) -> bool:
        """Add an edge between two key frames if their depth images show the same and determine how the two lie."""
        table = self._builder.kf
        target, source = (self._map_reliefs.of(int(table.frame[kf])) for kf in (kf_i, kf_j))
        if target is None or source is None:
            return False
        found = surface.align(se3.inverse(table.T_wk[kf_i]) @ table.T_wk[kf_j], source, target)
        if found.agreement < MIN_AGREEMENT or found.overlap < JOIN_OVERLAP or surface.n_determined(found.information, found.depth) < 6:
            return False
        self._builder.add_edge(kf_i, kf_j, found.T_ij, found.information)
        return True

    def _around(self, kf: int) -> np.ndarray:
        """Give the earlier key frames of the segment that stand and look nearly as `kf` does, nearest first."""
        table = self._builder.kf
        T_wk = table.T_wk[:kf]
        apart = np.linalg.norm(T_wk[:, :3, 3] - table.T_wk[kf, :3, 3], axis=1)
        cosine = T_wk[:, :3, 2] @ table.T_wk[kf, :3, 2]
        is_near = (table.segment[:kf] == table.segment[kf]) & (apart < JOIN_M) & (cosine > JOIN_COSINE)
        near = np.flatnonzero(is_near)
        return near[np.argsort(apart[near] + (1.0 - cosine[near]), kind="stable")]
