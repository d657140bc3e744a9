"""Draw figures over a rendered room: every part is a ray-cast ellipsoid or box, and the nearer of it and the room is seen."""

from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numba import f4, f8, i4, i8, u1

from slamcli.datasets.simulated.figures import BOX, BodyPart, Figure
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.jit.kernel import kernel

SAMPLES = np.array([[0.0, 0.0], [-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]])  # [px] the centre, then a rotated grid


@dataclass(frozen=True)
class Drawn:
    """Images with figures in them."""

    rgb: np.ndarray  # (H, W, 3) float32
    depth: np.ndarray  # (H, W) float32 [m]
    cosine: np.ndarray  # (H, W) float32, of the angle of incidence
    owner: np.ndarray  # (H, W) uint8, 1 + the figure that a pixel shows, 0 = the room


class _Parts(NamedTuple):
    """The parts of all figures, P of them."""

    half: f8[:, ::1]  # (P, 3) [m] half axes, or half sides
    kind: i4[::1]  # (P,)
    owner: i4[::1]  # (P,) 1 + the figure that each belongs to


class _Pictures(NamedTuple):
    """What is painted on the parts, each in several sizes."""

    level: i8[::1]  # (P + 1,) number of each part's first size
    size: i8[:, ::1]  # (M, 2) rows and columns
    start: i8[::1]  # (M,) row of each one's first pixel
    pixel: u1[:, ::1]  # (N, 3)
    texel: f8  # [m] side of a pixel of the largest


class _Placed(NamedTuple):
    """Where the parts stand."""

    T_pc: f8[:, :, ::1]  # (P, 4, 4) camera to part
    centre: f8[:, ::1]  # (P, 3) [m] in the camera's frame
    R_lp: f8[:, :, ::1]  # (P, 3, 3) part to level frame


class _Images(NamedTuple):
    """The fields of `Drawn`."""

    rgb: f4[:, :, ::1]
    depth: f4[:, ::1]
    cosine: f4[:, ::1]
    owner: u1[:, ::1]


class Crowd:
    """Figures that can be drawn into images of a room."""

    def __init__(self, figures: list[Figure], camera: Camera, *, texel: float, seed: int) -> None:
        """Paint all parts; `texel` is the side of the finest texture pixel [m]."""
        self._figures, self._camera, self._texel = figures, camera, texel
        parts = [(k, part) for k, figure in enumerate(figures) for part in figure.parts]
        owner, kind = (np.array(values, dtype=np.int32) for values in zip(*((k + 1, part.kind) for k, part in parts), strict=True))
        self._parts = _Parts(np.array([part.half for _, part in parts]), kind, owner)
        level, size, start, pixels = [0], [], [], []
        at = 0
        for number, (_, part) in enumerate(parts):
            image = _paint(part, np.random.default_rng([seed, 6, number]), texel)
            while True:
                size.append(image.shape[:2])
                start.append(at)
                pixels.append(image.reshape(-1, 3))
                at += image.shape[0] * image.shape[1]
                if min(image.shape[:2]) < 4:
                    break
                image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
            level.append(len(size))
        level_at, sizes, starts = (np.array(values, dtype=np.int64) for values in (level, size, start))
        self._pictures = _Pictures(level_at, sizes, starts, np.concatenate(pixels), texel)

    def through(self, camera: Camera) -> "Crowd":
        """Return the same figures for another camera."""
        other = copy(self)
        other._camera = camera
        return other

    def draw(self, T_lc: np.ndarray, stamp: float, rgb: np.ndarray, depth: np.ndarray, cosine: np.ndarray) -> Drawn:
        """Draw what a camera at T_lc sees at `stamp` over the room's colour, depth and cosine of incidence."""
        T_lp = np.concatenate([figure.pose(np.array([stamp]))[0] for figure in self._figures])
        c = self._camera
        T_pc = se3.inverse(T_lp) @ T_lc
        centre = (se3.inverse(T_lc) @ T_lp)[:, :3, 3]
        rgb, depth, cosine = (np.array(image, dtype=np.float32) for image in (rgb, depth, cosine))
        drawn = _Images(rgb, depth, cosine, np.zeros(depth.shape, dtype=np.uint8))
        placed = _Placed(*(np.ascontiguousarray(of) for of in (T_pc, centre, T_lp[:, :3, :3])))
        _draw(placed, self._parts, self._pictures, np.array([c.fx, c.fy, c.cx, c.cy]), SAMPLES, drawn)
        return Drawn(*drawn)


def _paint(part: BodyPart, rng: np.random.Generator, texel: float) -> np.ndarray:
    """Paint the picture that is wrapped around an ellipsoid, or that every side of a box shows."""
    if part.kind == BOX:
        width, height = 2 * max(part.half[0], part.half[1]), 2 * part.half[2]
    else:
        width, height = np.pi * (part.half[0] + part.half[1]), 2 * part.half[2]
    return np.ascontiguousarray(part.painter(rng, float(width), float(height), 1.0 / texel))


@kernel
def _draw(placed: _Placed, parts: _Parts, pictures: _Pictures, pinhole: f8[::1], samples: f8[:, ::1], images: _Images):
    """Draw parts into the images, whose depth is the room's. Each pixel is sampled once for depth and four times for colour."""
    T_pc, centre, R_lp = placed
    half, kind, part_owner = parts
    rgb, depth, cosine, owner = images
    rows, columns = depth.shape
    n_samples = len(samples)
    fx, fy, cx, cy = pinhole
    z = np.empty((n_samples, rows, columns), np.float32)
    for s in range(n_samples):
        z[s] = depth
    colour = np.empty((n_samples, rows, columns, 3), np.float32)
    hit = np.zeros((n_samples, rows, columns), np.bool_)
    for p in range(len(half)):
        reach = np.sqrt(half[p, 0] ** 2 + half[p, 1] ** 2 + half[p, 2] ** 2) if kind[p] == 1 else max(half[p, 0], half[p, 1], half[p, 2])
        left, right, top, bottom = _window(centre[p], reach, pinhole, rows, columns)
        T, R, h = T_pc[p], R_lp[p], half[p]
        ox, oy, oz = T[0, 3] / h[0], T[1, 3] / h[1], T[2, 3] / h[2]
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                for s in range(n_samples):
                    rx, ry = (column + samples[s, 0] - cx) / fx, (row + samples[s, 1] - cy) / fy
                    dx = (T[0, 0] * rx + T[0, 1] * ry + T[0, 2]) / h[0]
                    dy = (T[1, 0] * rx + T[1, 1] * ry + T[1, 2]) / h[1]
                    dz = (T[2, 0] * rx + T[2, 1] * ry + T[2, 2]) / h[2]
                    t = _meet(kind[p], ox, oy, oz, dx, dy, dz)
                    if not (0.05 < t < z[s, row, column]):
                        continue
                    z[s, row, column] = t
                    hit[s, row, column] = True
                    ux, uy, uz = ox + t * dx, oy + t * dy, oz + t * dz  # on the unit sphere or cube
                    nx, ny, nz, u, v = _unwrap(kind[p], ux, uy, uz)
                    nx, ny, nz = nx / h[0], ny / h[1], nz / h[2]
                    norm = np.sqrt(nx * nx + ny * ny + nz * nz)
                    nx, ny, nz = nx / norm, ny / norm, nz / norm
                    facing = abs(nx * dx * h[0] + ny * dy * h[1] + nz * dz * h[2]) / np.sqrt(rx * rx + ry * ry + 1.0)
                    if s == 0:
                        depth[row, column], cosine[row, column], owner[row, column] = t, facing, part_owner[p]
                        continue
                    up = R[2, 0] * nx + R[2, 1] * ny + R[2, 2] * nz
                    light = np.float32(0.5 + 0.22 * (1.0 + up) + 0.16 * facing)  # lamps above, walls around
                    detail = np.log2(max(t / fx / max(facing, 0.2) / pictures.texel, 1.0))
                    _paint_sample(pictures, p, detail, u, v, light, colour[s, row, column])
    share = np.float32(1.0 / (n_samples - 1))
    for row in range(rows):
        for column in range(columns):
            for k in range(3):
                own = rgb[row, column, k]
                total = np.float32(0.0)
                for s in range(1, n_samples):
                    total += colour[s, row, column, k] if hit[s, row, column] else own
                rgb[row, column, k] = share * total


@kernel
def _window(centre, reach, pinhole, rows, columns):
    """Return the first and last column and row in which what reaches so far around its centre may be seen; behind the camera none."""
    fx, fy, cx, cy = pinhole
    x, y, near, far = centre[0], centre[1], centre[2] - reach, centre[2] + reach
    if far < 0.05:
        return 0, -1, 0, -1
    left, right, top, bottom = 0, columns - 1, 0, rows - 1
    if near > 0.05:
        left = max(left, int(np.floor(cx + fx * min((x - reach) / near, (x - reach) / far) - 1)))
        right = min(right, int(np.ceil(cx + fx * max((x + reach) / near, (x + reach) / far) + 1)))
        top = max(top, int(np.floor(cy + fy * min((y - reach) / near, (y - reach) / far) - 1)))
        bottom = min(bottom, int(np.ceil(cy + fy * max((y + reach) / near, (y + reach) / far) + 1)))
    return left, right, top, bottom


@kernel
def _paint_sample(pictures, p, detail, u, v, light, out):
    """Write the colour (3,) of part p's picture at shares u, v of its width and height, in the size that shows so much detail."""
    level, size, start, pixel, _ = pictures
    m = min(level[p] + int(detail + 0.5), level[p + 1] - 1)
    n_rows, n_columns = size[m, 0], size[m, 1]
    su, sv = min(max(u * n_columns - 0.5, 0.0), n_columns - 1.001), min(max(v * n_rows - 0.5, 0.0), n_rows - 1.001)
    iu, iv = int(su), int(sv)
    fu, fv = np.float32(su - iu), np.float32(sv - iv)
    at = start[m] + iv * n_columns + iu
    for k in range(3):
        upper = pixel[at, k] * (1 - fu) + pixel[at + 1, k] * fu
        lower = pixel[at + n_columns, k] * (1 - fu) + pixel[at + n_columns + 1, k] * fu
        out[k] = light * (upper * (1 - fv) + lower * fv)


@kernel
def _meet(kind, ox, oy, oz, dx, dy, dz):
    """Intersect a ray with the unit sphere, or with the cube from -1 to 1: the first parameter, -1 where they miss."""
    if kind == 0:
        a, b, c = dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz - 1.0
        square = b * b - a * c
        return (-b - np.sqrt(square)) / a if square > 0.0 else -1.0
    first, last = -1e9, 1e9
    for o, d in ((ox, dx), (oy, dy), (oz, dz)):
        if abs(d) < 1e-12:
            if abs(o) > 1.0:
                return -1.0
            continue
        one, other = (-1.0 - o) / d, (1.0 - o) / d
        first, last = max(first, min(one, other)), min(last, max(one, other))
    return first if first < last else -1.0


@kernel
def _unwrap(kind, x, y, z):
    """Return the gradient of the unit sphere or cube at a point of it, and where in its picture that point is (shares of width and height)."""
    if kind == 0:
        return x, y, z, 0.5 + np.arctan2(y, x) / (2 * np.pi), 0.5 - 0.5 * z
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        return np.sign(x), 0.0, 0.0, 0.5 + 0.5 * y, 0.5 - 0.5 * z
    if ay >= az:
        return 0.0, np.sign(y), 0.0, 0.5 + 0.5 * x, 0.5 - 0.5 * z
    return 0.0, 0.0, np.sign(z), 0.5 + 0.5 * x, 0.5 - 0.5 * y
