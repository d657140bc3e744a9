"""The pinhole camera with Brown-Conrady distortion.

Pixel (0, 0) is the centre of the top-left pixel. Camera axes: x right, y down, z forward.
"""

from dataclasses import asdict, dataclass, fields
from functools import cached_property

import numpy as np

from slamcli.errors import SlamError

DEPTH_VALUES = 1 << 16  # of a 16-bit depth image
MAX_INVERSE_DEPTH_OFFSET = 0.1  # [1/m]; a Kinect's is some thousandths


@dataclass(frozen=True)
class Camera:
    """Intrinsics of the colour camera, to which depth is registered."""

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    depth_scale: float = 5000.0  # units of the depth image per metre
    inverse_depth_offset: float = 0.0  # 1/m, added to the inverse of each reading: a sensor that triangulates errs by a constant disparity

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
                raise SlamError(f"camera.{name} = {value!r}: must be a finite number")
        for name in ("width", "height"):
            size = getattr(self, name)
            if size != int(size) or not 1 <= size <= 16384:
                raise SlamError(f"camera.{name} = {size}: must be a whole number from 1 to 16384")
        for name in ("fx", "fy"):
            focal = getattr(self, name)
            if not 0.1 * self.width <= focal <= 20 * self.width:
                raise SlamError(f"camera.{name} = {focal:g}: not a focal length in pixels of an image {self.width} wide")
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not 0.0 <= getattr(self, name) <= size:
                raise SlamError(f"camera.{name} = {getattr(self, name):g}: the principal point is outside the image (0 to {size})")
        if not 1.0 <= self.depth_scale <= 1e6:
            raise SlamError(f"camera.depth_scale = {self.depth_scale:g}: must be depth units per metre, such as 5000 or 1000")
        if not abs(self.inverse_depth_offset) <= MAX_INVERSE_DEPTH_OFFSET:
            limit = f"{MAX_INVERSE_DEPTH_OFFSET:g} 1/m at most either way"
            raise SlamError(f"camera.inverse_depth_offset = {self.inverse_depth_offset:g}: must be {limit}")

    @property
    def K(self) -> np.ndarray:
        """Give the intrinsic matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Say whether any distortion coefficient differs from 0."""
        return any((self.k1, self.k2, self.p1, self.p2, self.k3))

    @cached_property
    def rays(self) -> np.ndarray:
        """Give per raw pixel the undistorted (x/z, y/z), (height, width, 2) float32: a pixel's point is depth * (x/z, y/z, 1)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return self.normalise(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(self.height, self.width, 2).astype(np.float32)

    @cached_property
    def metres(self) -> np.ndarray:
        """Give the depth (65536,) float32 [m] of every possible reading, NaN where there is none: one look-up converts and masks."""
        read = np.arange(DEPTH_VALUES, dtype=np.float32) / np.float32(self.depth_scale)
        read[0] = np.nan
        return self._from_read(read)

    def reread(self, depth: np.ndarray, given: "Camera") -> np.ndarray:
        """Give depth (...) [m], read under the calibration `given`, as it is under this one."""
        if (self.depth_scale, self.inverse_depth_offset) == (given.depth_scale, given.inverse_depth_offset):
            return depth
        with np.errstate(divide="ignore"):
            read = 1.0 / (1.0 / depth - given.inverse_depth_offset)
        return self._from_read(read * (given.depth_scale / self.depth_scale)).astype(depth.dtype)

    def _from_read(self, read: np.ndarray) -> np.ndarray:
        if self.inverse_depth_offset == 0.0:
            return read
        with np.errstate(divide="ignore"):
            inverse = 1.0 / read + self.inverse_depth_offset
        return np.where(inverse > 0.0, 1.0 / np.maximum(inverse, np.finfo(np.float32).tiny), np.nan).astype(read.dtype)

    def project(self, x_c: np.ndarray) -> np.ndarray:
        """Project points (..., 3) in front of the camera to undistorted pixels (..., 2)."""
        x_c = np.asarray(x_c, dtype=np.float64)
        return x_c[..., :2] / x_c[..., 2:] * [self.fx, self.fy] + [self.cx, self.cy]

    def backproject(self, xy: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Lift undistorted pixels (..., 2) with depth (...) [m] to points (..., 3); [L] (14)."""
        xy, depth = np.asarray(xy, dtype=np.float64), np.asarray(depth, dtype=np.float64)
        normal = (xy - [self.cx, self.cy]) / [self.fx, self.fy]
        return np.concatenate([normal * depth[..., None], depth[..., None]], axis=-1)

    def distort(self, xy: np.ndarray) -> np.ndarray:
        """Map undistorted pixels (..., 2) to raw pixels (..., 2)."""
        if not self.is_distorted:
            return np.array(xy, dtype=np.float64)
        normal = (np.asarray(xy, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        return self._distort_normal(normal) * [self.fx, self.fy] + [self.cx, self.cy]

    def undistort(self, xy: np.ndarray) -> np.ndarray:
        """Map raw pixels (..., 2) to undistorted pixels (..., 2)."""
        if not self.is_distorted:
            return np.array(xy, dtype=np.float64)
        return self.normalise(xy) * [self.fx, self.fy] + [self.cx, self.cy]

    def normalise(self, xy: np.ndarray) -> np.ndarray:
        """Give the directions (x/z, y/z), (..., 2), of raw pixels (..., 2)."""
        raw = (np.asarray(xy, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        if not self.is_distorted:
            return raw
        from slamcli.geometry import lens  # numba takes a third of a second to load

        normal = np.empty_like(raw)
        lens.undistort(np.ascontiguousarray(raw).reshape(-1, 2), self.k1, self.k2, self.k3, self.p1, self.p2, normal.reshape(-1, 2))
        return normal

    def _distort_normal(self, normal: np.ndarray) -> np.ndarray:
        x, y = normal[..., 0], normal[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
                y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def to_dict(self) -> dict:
        """Give the keys of `camera.json`."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict, *, source: str) -> "Camera":
        """Build a camera from the keys of `camera.json` / `camera.toml`; SlamError names `source` and the key at fault."""
        known = {f.name for f in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise SlamError(f"{source}: camera key {unknown[0]!r} is not known; known are {', '.join(sorted(known))}")
        missing = [n for n in ("width", "height", "fx", "fy", "cx", "cy", "depth_scale") if n not in values]
        if missing:
            raise SlamError(f"{source}: camera key {missing[0]!r} is missing")
        try:
            return cls(**values)
        except SlamError as error:
            raise SlamError(f"{source}: {error}") from None
