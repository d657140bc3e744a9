"""The pinhole camera and its lens: Brown-Conrady, rational or equidistant distortion.

Pixel (0, 0) is the centre of the top-left pixel. Camera axes: x right, y down, z forward.
"""

from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property

import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry import elementary

DEPTH_VALUES = 1 << 16  # of a 16-bit depth image
NO_READING = (0, DEPTH_VALUES - 1)  # 16-bit readings that mean none: 0 everywhere, the largest value of cameras that saturate
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
MAX_DISTORTION = 1e4  # of a coefficient; rational models of real lenses reach some hundreds
LARGEST = 1e9  # of any of the numbers below: beyond, it is no camera and its squares are no numbers
MAX_INVERSE_DEPTH_OFFSET = 0.1  # [1/m]; a Kinect's is some thousandths
POLYNOMIAL, EQUIDISTANT = "polynomial", "equidistant"  # values of Camera.lens
LATER_FIELDS = {"k4": 0.0, "k5": 0.0, "k6": 0.0, "lens": POLYNOMIAL}  # written only where they say something
ON_AXIS = 1e-9  # tangent of the angle from the axis within which a lens bends nothing
LARGEST_SIDE = 16384  # [px]
FOCAL_LENGTHS = (0.1, 20.0)  # shares of the width: 157 degrees across, and 3
DEPTH_SCALES = (1.0, 1e6)  # units a metre
SHAPE_TOLERANCE = 0.01  # by which width and height may be scaled differently: sizes are rounded


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
    k4: float = 0.0  # k4 k5 k6: denominator of the rational model, OpenCV's CALIB_RATIONAL_MODEL; equidistant: k1 k2 k3 k4 of its fisheye
    k5: float = 0.0
    k6: float = 0.0
    lens: str = POLYNOMIAL  # or EQUIDISTANT

    def __post_init__(self) -> None:
        if self.lens not in (POLYNOMIAL, EQUIDISTANT):
            raise SlamError(f"camera.lens = {self.lens!r}: must be {POLYNOMIAL} or {EQUIDISTANT}")
        for name in (f.name for f in fields(self) if f.name != "lens"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not -LARGEST <= value <= LARGEST:
                shown = repr(value)[:40] if not isinstance(value, int) or isinstance(value, bool) else "a number of too many digits"
                raise SlamError(f"camera.{name} = {shown}: must be a finite number")
        for name in ("width", "height"):
            size = getattr(self, name)
            if size != int(size) or not 1 <= size <= LARGEST_SIDE:
                raise SlamError(f"camera.{name} = {size}: must be a whole number from 1 to {LARGEST_SIDE}")
        for name in ("fx", "fy"):
            focal = getattr(self, name)
            if not FOCAL_LENGTHS[0] * self.width <= focal <= FOCAL_LENGTHS[1] * self.width:
                raise SlamError(f"camera.{name} = {focal:g}: not a focal length in pixels of an image {self.width} wide")
        for name in DISTORTION:
            if not abs(getattr(self, name)) <= MAX_DISTORTION:
                raise SlamError(f"camera.{name} = {getattr(self, name):g}: no lens bends like that; is it a number of another kind?")
        for name, size in (("cx", self.width), ("cy", self.height)):
            if not 0.0 <= getattr(self, name) <= size:
                raise SlamError(f"camera.{name} = {getattr(self, name):g}: the principal point is outside the image (0 to {size})")
        if not DEPTH_SCALES[0] <= self.depth_scale <= DEPTH_SCALES[1]:
            raise SlamError(f"camera.depth_scale = {self.depth_scale:g}: must be depth units per metre, such as 5000 or 1000")
        if not abs(self.inverse_depth_offset) <= MAX_INVERSE_DEPTH_OFFSET:
            limit = f"{MAX_INVERSE_DEPTH_OFFSET:g} 1/m at most either way"
            raise SlamError(f"camera.inverse_depth_offset = {self.inverse_depth_offset:g}: must be {limit}")

    @property
    def K(self) -> np.ndarray:
        """Return the intrinsic matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Say whether the lens bends rays."""
        return self.lens != POLYNOMIAL or self.is_rational or any((self.k1, self.k2, self.p1, self.p2, self.k3))

    @property
    def is_rational(self) -> bool:
        """Say whether the polynomial of the lens has a denominator."""
        return self.lens == POLYNOMIAL and any((self.k4, self.k5, self.k6))

    @property
    def coefficients(self) -> np.ndarray:
        """Return k1 k2 p1 p2 k3 k4 k5 k6, (8,), the order of OpenCV and ROS."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6], dtype=np.float64)

    def scaled(self, width: int, height: int) -> "Camera":
        """Return the camera of the same pictures in another size; SlamError where the shape is another."""
        across, down = width / self.width, height / self.height
        if abs(across / down - 1.0) > SHAPE_TOLERANCE:
            raise SlamError(f"a calibration for {self.width} x {self.height} px does not fit images of {width} x {height}: another shape")
        return replace(
            self, width=width, height=height, fx=self.fx * across, fy=self.fy * down,
            cx=(self.cx + 0.5) * across - 0.5, cy=(self.cy + 0.5) * down - 0.5,
        )  # fmt: skip

    def turned(self) -> "Camera":
        """Return the camera of the same pictures turned clockwise by 90 degrees."""
        if self.is_distorted and (self.p1, self.p2) != (0.0, 0.0):
            raise SlamError("a calibration with tangential distortion cannot be turned with its pictures; give that of these images")
        return replace(self, width=self.height, height=self.width, fx=self.fy, fy=self.fx, cx=self.height - 1.0 - self.cy, cy=self.cx)

    @cached_property
    def rays(self) -> np.ndarray:
        """Return per raw pixel the undistorted (x/z, y/z), (height, width, 2) float32: a pixel's point is depth * (x/z, y/z, 1)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return self.normalize(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(self.height, self.width, 2).astype(np.float32)

    @cached_property
    def metres(self) -> np.ndarray:
        """Return the depth (65536,) float32 [m] of every possible reading, NaN where there is none: one look-up converts and masks."""
        read = np.arange(DEPTH_VALUES, dtype=np.float32) / np.float32(self.depth_scale)
        read[list(NO_READING)] = np.nan
        return self._from_read(read)

    def to_metres(self, raw: np.ndarray) -> np.ndarray:
        """Convert readings (...), uint16 or floating, to depth (...) float32 [m], NaN where there is none."""
        if raw.dtype == np.uint16:
            from slamcli.geometry.lookup import look_up

            return look_up(self.metres, raw)
        read = raw.astype(np.float32) / np.float32(self.depth_scale)
        with np.errstate(invalid="ignore"):
            read[~((read > 0.0) & (read < np.inf))] = np.nan
        return self._from_read(read)

    def reread(self, depth: np.ndarray, given: "Camera") -> np.ndarray:
        """Return depth (...) [m], read under the calibration `given`, as it is under this one."""
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
        return self.normalize(xy) * [self.fx, self.fy] + [self.cx, self.cy]

    def normalize(self, xy: np.ndarray) -> np.ndarray:
        """Return the directions (x/z, y/z), (..., 2), of raw pixels (..., 2)."""
        raw = (np.asarray(xy, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        if not self.is_distorted:
            return raw
        from slamcli.geometry import lens  # numba takes a third of a second to load

        normal, flat = np.empty_like(raw), np.ascontiguousarray(raw).reshape(-1, 2)
        if self.lens == EQUIDISTANT:
            lens.undistort_equidistant(flat, self.coefficients[[0, 1, 4, 5]], normal.reshape(-1, 2))
        elif self.is_rational:
            lens.undistort_rational(flat, self.coefficients, normal.reshape(-1, 2))
        else:
            lens.undistort(flat, self.k1, self.k2, self.k3, self.p1, self.p2, normal.reshape(-1, 2))
        return normal

    def _distort_normal(self, normal: np.ndarray) -> np.ndarray:
        x, y = normal[..., 0], normal[..., 1]
        r2 = x * x + y * y
        if self.lens == EQUIDISTANT:
            return normal * self._equidistant_factor(np.sqrt(r2))[..., None]
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        if self.is_rational:
            radial = radial / (1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)))
        return np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
                y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def _equidistant_factor(self, r: np.ndarray) -> np.ndarray:
        """Return by what the distance r from the axis on the plane z = 1 is multiplied: theta (1 + k1 theta^2 + ..) / r."""
        theta = elementary.arctan2(r, 1.0)
        theta2 = theta * theta
        theta_d = theta * (1.0 + theta2 * (self.k1 + theta2 * (self.k2 + theta2 * (self.k3 + theta2 * self.k4))))
        return np.where(r > ON_AXIS, theta_d / np.maximum(r, ON_AXIS), 1.0)

    def to_dict(self) -> dict:
        """Return the keys of `camera.json`; what only other lenses have is left out."""
        return {name: value for name, value in asdict(self).items() if name not in LATER_FIELDS or value != LATER_FIELDS[name]}

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
