"""One camera for the pictures of several: every measurement of a direction can be told in the pixels of another camera at the same place."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_registration import Registration

WIDEST = 1.5  # tangent of the angle from the axis up to which the common camera sees: 113 degrees across
LEAST_SIDE = 1e-3  # tangent of the angle that it sees at least to every side: the principal point lies in the picture
MOST_PIXELS = 1_100_000  # of the common camera, above which it is made coarser
NOWHERE = -1e4  # [px] a place outside every picture
BORDER_POINTS = 33  # along each side of a picture, whose directions tell what it sees


def common_camera(cameras: Sequence[Camera]) -> Camera:
    """Choose a camera in whose pixels the pictures of all `cameras` can be told.

    Where all have the same intrinsics it is that camera, lens and all. Else it has no lens distortion, the finest of their resolutions,
    and sees what any of them does, up to `WIDEST` and `MOST_PIXELS`.
    """
    first = cameras[0]
    if all(have_same_pixels(first, camera) for camera in cameras):
        return first
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for camera in cameras:
        seen = np.clip(camera.normalize(_border(camera)), -WIDEST, WIDEST)
        low, high = np.minimum(low, seen.min(axis=0)), np.maximum(high, seen.max(axis=0))
    low, high = np.minimum(low, -LEAST_SIDE), np.maximum(high, LEAST_SIDE)
    focal = max(focal_length(camera) for camera in cameras)
    focal = min(focal, float(np.sqrt(MOST_PIXELS / np.prod(high - low))))
    width, height = (int(size) for size in np.ceil(focal * (high - low)))
    cx, cy = (float(c) for c in -low * focal - 0.5)
    return Camera(width, height, focal, focal, max(cx, 0.0), max(cy, 0.0), depth_scale=first.depth_scale)


def have_same_pixels(a: Camera, b: Camera) -> bool:
    """Say whether two cameras see the same direction in each pixel; the unit of their depth may differ."""
    return replace(a, depth_scale=b.depth_scale, inverse_depth_offset=b.inverse_depth_offset) == b


def focal_length(camera: Camera) -> float:
    """Return the geometric mean of both focal lengths [px]."""
    return float(np.sqrt(camera.fx * camera.fy))


def _border(camera: Camera) -> np.ndarray:
    """Return raw pixels (N, 2) along the border of a picture."""
    along = np.linspace(-0.5, 0.5, BORDER_POINTS)
    sides = [np.column_stack([along, np.full_like(along, end)]) for end in (-0.5, 0.5)]
    unit = np.concatenate([*sides, *(side[:, ::-1] for side in sides)]) + 0.5
    return unit * [camera.width, camera.height] - 0.5


@dataclass(frozen=True)
class Retelling:
    """Tells what camera `own` measured in the pixels of camera `common`."""

    own: Camera
    common: Camera

    @cached_property
    def is_identity(self) -> bool:
        """Say whether both have the same pixels, so that nothing changes."""
        return have_same_pixels(self.own, self.common)

    @property
    def magnification(self) -> float:
        """Return the common camera's pixels per pixel of the own."""
        return focal_length(self.common) / focal_length(self.own)

    def pixels(self, xy: np.ndarray) -> np.ndarray:
        """Tell undistorted pixels (..., 2) of the own camera as such of the common one, in the type they have."""
        if self.is_identity:
            return xy
        direction = (np.asarray(xy, dtype=np.float64) - [self.own.cx, self.own.cy]) / [self.own.fx, self.own.fy]
        return (direction * [self.common.fx, self.common.fy] + [self.common.cx, self.common.cy]).astype(xy.dtype)

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """Tell a depth image (h, w) float32 [m] as the common camera sees it, (H, W), NaN = none."""
        return depth if self.is_identity else self._registration.apply(depth)

    @cached_property
    def _registration(self) -> Registration:
        return Registration(self.own, self.common, np.eye(4))

    @cached_property
    def source(self) -> np.ndarray:
        """Return per raw pixel of the common camera the raw pixel of the own that shows the same direction, (H, W, 2) float32."""
        direction = self.common.rays.astype(np.float64)
        undistorted = direction * [self.own.fx, self.own.fy] + [self.own.cx, self.own.cy]
        raw = self.own.distort(undistorted)
        # Beyond its picture a lens model may fold back into it.
        is_folded = np.linalg.norm(self.own.undistort(raw) - undistorted, axis=-1) > 1.0
        raw[is_folded] = NOWHERE
        return raw.astype(np.float32)
