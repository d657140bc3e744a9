"""Depth of one camera seen by another: registered to the colour camera, or brought to the size of its pictures."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import f4, f8, i8

from slamcli.geometry import elementary, se3
from slamcli.geometry.algebra import inverse, product
from slamcli.geometry.camera import EQUIDISTANT, ON_AXIS, Camera
from slamcli.jit.kernel import kernel

OVERLAP = 1.1  # by which the footprints of neighbouring readings overlap, so that a slanted surface shows no holes
PATH_REACH = 0.1  # of a point's depth, by which the offset of the cameras may move it on a path that is a cubic
SURFACE = 0.03  # relative difference up to which neighbouring readings are of one surface
LEAST_FACING = 0.5  # cosine between the cameras' axes, from which on a step between pixels tells one between readings
REACH = 2  # [px] on either side, over which a surface's slope is measured: over fewer the noise of two readings would count as slope


class ToColour(NamedTuple):
    """Where readings lie among the pixels of the colour camera; ray, near and path as in `Registration`."""

    ray: f4[:, :, ::1]  # (h, w, 3): x_c = depth * ray + t
    t: f8[::1]  # (3,) [m]
    intrinsics: f8[::1]  # (4,) fx, fy, cx, cy
    lens: i8  # as in `bend`; 0 = none
    k: f8[::1]  # (8,) as in `bend`
    near: f8  # [m]
    path: f4[:, :, :, ::1]  # (h, 2, 4, w)
    half: f8[::1]  # (2,) half a footprint's width and height [px] at equal distances
    back: f8[:, ::1]  # (2, 2) from steps between pixels to steps between readings (row u, column v), at equal distances


@dataclass(frozen=True)
class Registration:
    """Where the depth camera sits, and what it must be brought to."""

    depth_camera: Camera
    colour_camera: Camera
    T_cd: np.ndarray  # (4, 4) float64, depth camera to colour camera

    @cached_property
    def _ray(self) -> np.ndarray:
        """Return per pixel of the depth camera its ray in the colour camera's axes, (h, w, 3) float32: x_c = depth * ray + t."""
        ray = np.ones((self.depth_camera.height, self.depth_camera.width, 3))
        ray[..., :2] = self.depth_camera.rays
        return np.ascontiguousarray(se3.rotate(self.T_cd[:3, :3], ray).astype(np.float32))

    @cached_property
    def _near(self) -> float:
        """Return the least depth [m] for which `_path` holds: there the offset of the cameras moves a point by PATH_REACH of its depth."""
        return max(float(np.sqrt(np.square(self.T_cd[:3, 3]).sum())) / PATH_REACH, 1e-6)

    @cached_property
    def _path(self) -> np.ndarray:
        """Return how the raw pixel of the colour camera moves as what a pixel of the depth camera sees comes nearer, (h, 2, 4, w) float32.

        u, v = sum over n of path[.., n, ..] (near / depth)^n: what a lens does to it is too slow to be computed for each reading. Empty without a lens.
        """
        if not self.colour_camera.is_distorted:
            return np.empty((0, 2, 4, 0), dtype=np.float32)
        nearness = 0.5 - 0.5 * elementary.cos(np.pi * (np.arange(4) + 0.5) / 4.0)  # where the error of a cubic is least
        pixel = np.empty((4, *self._ray.shape[:2], 2))
        for k, share in enumerate(nearness):
            x = self._ray + share / self._near * self.T_cd[:3, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                pixel[k] = self.colour_camera.distort(self.colour_camera.project(np.where(x[..., 2:] > 0.0, x, np.nan)))
        powers = inverse(np.stack([nearness**n for n in range(4)], axis=1))
        return np.ascontiguousarray(product(powers, pixel.reshape(4, -1)).reshape(pixel.shape).transpose(1, 3, 0, 2).astype(np.float32))

    @cached_property
    def _back(self) -> np.ndarray:
        """Return what takes steps between pixels to steps between readings, (2, 2) as in `ToColour`; zeros, and so no slope, beyond LEAST_FACING."""
        if self.T_cd[2, 2] < LEAST_FACING:
            return np.zeros((2, 2))
        to, of = self.colour_camera, self.depth_camera
        return inverse(self.T_cd[:2, :2] * np.array([to.fx, to.fy])[:, None] / np.array([of.fx, of.fy]))

    def apply(self, depth: np.ndarray) -> np.ndarray:
        """Return depth (h, w) float32 [m] of the depth camera as the colour camera would see it, (H, W) float32, NaN = none.

        Each reading covers its footprint among the raw pixels of the colour camera. Where several do, the nearest surface counts, and of its
        readings the one whose middle is closest to the pixel's: the nearest reading would bring floors closer by half a pixel. From there
        to the pixel the reading follows its surface's slope, which is worth 5 mm of half a pixel of floor at 2 m.
        """
        to = self.colour_camera
        out, away = (np.full((to.height, to.width), np.inf, dtype=np.float32) for _ in range(2))
        magnification = np.array([to.fx / self.depth_camera.fx, to.fy / self.depth_camera.fy])
        lens = 2 if to.lens == EQUIDISTANT else 3 if to.is_rational else 1 if to.is_distorted else 0
        intrinsics = np.array([to.fx, to.fy, to.cx, to.cy])
        to_colour = ToColour(
            self._ray, self.T_cd[:3, 3].copy(), intrinsics, lens, to.coefficients, self._near, self._path,
            half=0.5 * OVERLAP * magnification, back=self._back,
        )  # fmt: skip
        splat(np.ascontiguousarray(depth), to_colour, out, away)
        return out


def resized(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Bring depth (h, w) float32 [m] to another size of the same field of view, (height, width) float32, NaN = none.

    Readings of one surface are interpolated; at a jump of depth the nearest pixel's counts, so that nothing floats in between.
    """
    if depth.shape == (height, width):
        return depth
    out = np.empty((height, width), dtype=np.float32)
    resample(np.ascontiguousarray(depth), out)
    return out


@kernel
def bend(x, y, lens, k):
    """Return the point (x, y) of the plane z = 1 as the lens maps it.

    lens : 1 polynomial, 2 equidistant, 3 rational; k : (8,) as in Camera.coefficients
    """
    r2 = x * x + y * y
    if lens == 2:
        r = math.sqrt(r2)
        if r < ON_AXIS:
            return x, y
        t = elementary.arctangent2(r, 1.0)
        t2 = t * t
        factor = t * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[4] + t2 * k[5])))) / r
        return x * factor, y * factor
    radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    if lens == 3:
        radial /= 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    bent_x = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x)
    bent_y = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y
    return bent_x, bent_y


@kernel
def measure_rises(depth: f4[:, ::1], i: i8, across: f4[::1], down: f4[::1]):
    """Measure by how much [m] the surface at each reading of row `i` recedes from one column, and from one row, to the next; 0 at jumps and borders.

    across, down : (w,), zeros before the first row
    """
    rows, columns = depth.shape
    straight, steep, step = f4(SURFACE), f4(2 * REACH * SURFACE), f4(1.0 / (2 * REACH))
    for j in range(REACH, columns - REACH):  # without a branch: several pixels a step
        d, left, right = depth[i, j], depth[i, j - REACH], depth[i, j + REACH]
        rise = right - left
        across[j] = rise * step if (abs(left + right - d - d) <= straight * d) & (abs(rise) <= steep * d) else f4(0.0)
    if i < REACH or i >= rows - REACH:
        down[:] = 0.0
        return
    for j in range(columns):
        d, above, below = depth[i, j], depth[i - REACH, j], depth[i + REACH, j]
        rise = below - above
        down[j] = rise * step if (abs(above + below - d - d) <= straight * d) & (abs(rise) <= steep * d) else f4(0.0)


@kernel(error_model="numpy")
def splat(depth: f4[:, ::1], to: ToColour, out: f4[:, ::1], away: f4[:, ::1]):
    """Lay each reading of `depth` on `out` (H, W), filled with inf before; the nearest surface wins, and what is left uncovered becomes NaN.

    away (H, W), filled with inf before: [px^2] from each pixel to the middle of the reading that it shows.
    """
    ray, t, intrinsics, lens, k, near, path, half, back = to
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    rows, columns, width = out.shape[0], out.shape[1], depth.shape[1]
    us, vs, zs, sizes = np.empty(width), np.empty(width), np.empty(width), np.empty(width)
    across, down, slope_u, slope_v = np.zeros((4, width), np.float32)
    for i in range(depth.shape[0]):
        for j in range(width):  # without a branch: several pixels a step
            d = f8(depth[i, j])
            zs[j] = d * ray[i, j, 2] + t[2]
            sizes[j] = d / zs[j]
        if lens == 0:
            for j in range(width):
                d, inverse = f8(depth[i, j]), 1.0 / zs[j]
                us[j], vs[j] = fx * ((d * ray[i, j, 0] + t[0]) * inverse) + cx, fy * ((d * ray[i, j, 1] + t[1]) * inverse) + cy
        else:
            for j in range(width):
                s = near / f8(depth[i, j])
                us[j] = path[i, 0, 0, j] + s * (path[i, 0, 1, j] + s * (path[i, 0, 2, j] + s * path[i, 0, 3, j]))
                vs[j] = path[i, 1, 0, j] + s * (path[i, 1, 1, j] + s * (path[i, 1, 2, j] + s * path[i, 1, 3, j]))
        measure_rises(depth, i, across, down)
        for j in range(width):
            nearer = f4(1.0 / (sizes[j] * sizes[j]))
            slope_u[j] = (across[j] * f4(back[0, 0]) + down[j] * f4(back[1, 0])) * nearer
            slope_v[j] = (across[j] * f4(back[0, 1]) + down[j] * f4(back[1, 1])) * nearer
        for j in range(width):
            d, z, u, v = f8(depth[i, j]), zs[j], us[j], vs[j]
            if not (d > 0.0 and z > 0.0):
                continue
            if lens != 0 and not d >= near:
                x, y = bend((d * ray[i, j, 0] + t[0]) / z, (d * ray[i, j, 1] + t[1]) / z, lens, k)
                u, v = fx * x + cx, fy * y + cy
            if not (u > -0.5 and v > -0.5 and u < columns - 0.5 and v < rows - 0.5):
                continue
            half_u, half_v = min(half[0] * sizes[j], u + 1.0), min(half[1] * sizes[j], v + 1.0)
            left, right = int(u - half_u + 1.0), min(int(u + half_u), columns - 1)  # u - half_u > -1 here: truncation rounds down
            top, bottom = int(v - half_v + 1.0), min(int(v + half_v), rows - 1)
            reading = f4(z)
            before, beside = f4(reading * (1.0 + SURFACE)), f4(reading * (1.0 - SURFACE))
            at_u, at_v, rise_u, rise_v = f4(u), f4(v), slope_u[j], slope_v[j]
            for row in range(top, bottom + 1):
                below = f4(row) - at_v
                for column in range(left, right + 1):
                    there, beyond = out[row, column], f4(column) - at_u
                    aside = beyond * beyond + below * below
                    if before < there or (beside <= there and aside < away[row, column]):
                        out[row, column], away[row, column] = reading + rise_u * beyond + rise_v * below, aside
    for row in range(rows):
        for column in range(columns):
            if out[row, column] == np.inf:
                out[row, column] = np.nan


@kernel
def resample(depth: f4[:, ::1], out: f4[:, ::1]):
    """Fill `out` (H, W) with `depth` (h, w) in its size, pixel centres on whole numbers in both."""
    rows, columns = depth.shape
    across, down = columns / out.shape[1], rows / out.shape[0]
    for i in range(out.shape[0]):
        v = min(max((i + 0.5) * down - 0.5, 0.0), rows - 1.0)
        top = min(int(v), max(rows - 2, 0))
        bottom = min(top + 1, rows - 1)
        b = v - top
        for j in range(out.shape[1]):
            u = min(max((j + 0.5) * across - 0.5, 0.0), columns - 1.0)
            left = min(int(u), max(columns - 2, 0))
            right = min(left + 1, columns - 1)
            a = u - left
            p, q, r, s = depth[top, left], depth[top, right], depth[bottom, left], depth[bottom, right]
            low, high = min(min(p, q), min(r, s)), max(max(p, q), max(r, s))
            if p == p and q == q and r == r and s == s and high - low <= SURFACE * low:
                out[i, j] = (1.0 - b) * ((1.0 - a) * p + a * q) + b * ((1.0 - a) * r + a * s)
            else:
                out[i, j] = depth[bottom if b >= 0.5 else top, right if a >= 0.5 else left]
