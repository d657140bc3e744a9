"""Paint a mesh with the images that saw it: a texture whose colours come from the sharpest, nearest and most frontal views.

A texel's colour is the mean over the views that see it, weighted so steeply by their quality that the best one decides, while at its
borders the next best takes over without a seam. Quality after M. Waechter, N. Moehrle, M. Goesele, Let There Be Color!, ECCV 2014,
doi:10.1007/978-3-319-10602-1_54. Open3D's UVAtlas cuts the surface into charts.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import f4, f8, i4, i8, u1

from slamcli.dense.mesh_cleaning import triangle_areas
from slamcli.dense.tsdf import Mesh
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.jit.kernel import kernel
from slamcli.open3d_loader import load_open3d

GUTTER = 3.0  # [texels] between charts, so that none bleeds into another when it is drawn small
STRETCH = 0.3  # of a chart, 0 to 1: the less, the more charts
LEAST_COSINE = 0.15  # between the surface's normal and the line of sight: flatter views smear
FEATHER = 0.2  # of an image's height, from its border on, over which its quality falls to 0: no view ends in a seam
NEAREST = 0.1  # [m]
TOLERANCE, TOLERANCE_GROWTH = 0.025, 0.01  # [m], [1/m]: by how much a reading at depth z may differ from the surface, base + growth z^2
EDGE = 2  # [px] from what stands in front: depth and colour do not end in the same pixel
BACKGROUND = 127  # grey level of texels of no chart, beyond the gutter


@dataclass(frozen=True)
class Textured:
    """A mesh with a picture on it."""

    mesh: Mesh
    uv: np.ndarray  # (M, 3, 2) float32 in [0, 1]: of each triangle's corners, right and down from the picture's upper left corner
    picture: np.ndarray  # (S, S, 3) uint8


class Pinhole(NamedTuple):
    """Intrinsics [px] of images without distortion."""

    fx: float
    fy: float
    cx: float
    cy: float


def unwrap(mesh: Mesh, *, size: int) -> np.ndarray:
    """Cut a mesh into charts and lay them out on a square of `size` texels; returns uv (M, 3, 2) float32 in [0, 1].

    K. Zhou, J. Snyder, B. Guo, H.-Y. Shum, Iso-charts, SGP 2004, doi:10.2312/SGP/SGP04/047-056. Raises SlamError where that fails.
    """
    o3d = load_open3d()
    flat = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(mesh.xyz), o3d.core.Tensor(mesh.triangle.astype(np.int64)))
    try:  # one thread, one partition: the charts do not follow the machine
        flat.compute_uvatlas(size=size, gutter=GUTTER, max_stretch=STRETCH, parallel_partitions=1, nthreads=1)
    except RuntimeError as error:
        raise SlamError(f"the mesh cannot be laid out for a texture ({error}); try fewer triangles or larger voxels") from error
    return np.ascontiguousarray(flat.triangle.texture_uvs.numpy(), dtype=np.float32)


def sharpness(grey: np.ndarray) -> float:
    """Return how fast an image's brightness bends where it changes, a number without unit: blur makes it small, texture does not."""
    import cv2

    image = grey.astype(np.float32)
    change = sum(np.abs(cv2.Sobel(image, cv2.CV_32F, *axis)).mean(dtype=np.float64) for axis in ((1, 0), (0, 1)))
    return float(np.abs(cv2.Laplacian(image, cv2.CV_32F)).mean(dtype=np.float64) / max(change, 1.0))


class TexelSurface(NamedTuple):
    """M triangles and the N texels on them, sorted by triangle."""

    first: i4[::1]  # (M + 1,) row of each triangle's first texel
    corner: f4[:, :, ::1]  # (M, 3, 3) [m]
    normal: f4[:, ::1]  # (M, 3)
    xyz: f4[:, ::1]  # (N, 3) [m] of the texels


class Shown(NamedTuple):
    """What a view shows, without a lens's distortion."""

    rgb: u1[:, :, ::1]  # (H, W, 3)
    depth: f4[:, ::1]  # (H, W) [m], 0 = none
    near: f4[:, ::1]  # (H, W) [m] the least readings around each pixel
    T_cw: f8[:, ::1]  # (4, 4)
    centre: f8[::1]  # (3,) [m] of the camera, in the mesh's frame
    quality: f8


class Paint(NamedTuple):
    """What views have given to N texels."""

    total: f4[:, ::1]  # (N, 3) colours times weights
    weight: f4[::1]  # (N,)


class Painter:
    """A texture in the making: views are added one at a time."""

    def __init__(self, mesh: Mesh, uv: np.ndarray, camera: Camera, *, size: int) -> None:
        """Place `size` x `size` texels on the mesh; uv (M, 3, 2) as from `unwrap`."""
        self._mesh, self._uv, self._size = mesh, uv, size
        self._pinhole = Pinhole(camera.fx, camera.fy, camera.cx, camera.cy)
        self._raw = _raw_pixels(camera) if camera.is_distorted else None
        owner = np.full((size, size), -1, dtype=np.int32)
        _own(uv, owner)
        texel = np.flatnonzero(owner.ravel() >= 0)
        of = owner.ravel()[texel]
        order = np.argsort(of, kind="stable")
        self._texel, of = texel[order].astype(np.int32), of[order]
        first = np.searchsorted(of, np.arange(len(uv) + 1)).astype(np.int32)
        share = np.empty((len(of), 3), dtype=np.float32)
        _weigh_corners(uv, self._texel, first, size, share)
        corner = np.ascontiguousarray(mesh.xyz[mesh.triangle])
        a, b, c = corner.transpose(1, 0, 2).astype(np.float64)
        normal = np.cross(b - a, c - a)
        normal = (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)).astype(np.float32)
        self._surface = TexelSurface(first, corner, normal, _mixed(corner, share, of))
        self._plain = _mixed(mesh.rgb[mesh.triangle].astype(np.float32), share, of)
        self._paint = Paint(np.zeros((len(of), 3), np.float32), np.zeros(len(of), np.float32))

    def add(self, rgb: np.ndarray, depth: np.ndarray, T_wc: np.ndarray, *, quality: float) -> None:
        """Paint what one view sees.

        rgb : (H, W, 3) uint8; depth : (H, W) float32 [m], NaN = none, both with the lens's distortion; T_wc : (4, 4) camera to the
        mesh's frame; quality : the higher, the more the view counts beside others
        """
        import cv2

        rgb, depth = np.ascontiguousarray(rgb), np.nan_to_num(depth, nan=0.0).astype(np.float32)
        if self._raw is not None:
            rgb = cv2.remap(rgb, *self._raw, cv2.INTER_LINEAR)
            depth = cv2.remap(depth, *self._raw, cv2.INTER_NEAREST)
        near = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), np.ones((2 * EDGE + 1,) * 2, np.uint8))
        T_cw, centre = np.ascontiguousarray(se3.inverse(T_wc)), np.ascontiguousarray(T_wc[:3, 3])
        _add(self._surface, Shown(rgb, depth, near, T_cw, centre, float(quality)), self._pinhole, self._paint)

    def covered(self) -> float:
        """Return the share of the surface's area in [0, 1] that views have painted."""
        area = triangle_areas(self._mesh)
        first, weight = self._surface.first, self._paint.weight
        n = np.diff(first)
        painted = np.add.reduceat(np.append(weight > 0, False).astype(np.int64), first[:-1]) * (n > 0)
        return float((area * painted / np.maximum(n, 1)).sum() / max(area[n > 0].sum(), 1e-12))

    def textured(self) -> Textured:
        """Return the mesh with its picture; where no view reached, the picture shows the vertices' colours."""
        import cv2

        total, weight = self._paint.total, self._paint.weight[:, None]
        mean = np.where(weight > 0, total / np.maximum(weight, 1e-30), self._plain)
        picture = np.full((self._size * self._size, 3), BACKGROUND, dtype=np.uint8)
        picture[self._texel] = np.clip(np.rint(mean), 0, 255).astype(np.uint8)
        is_empty = np.ones(self._size * self._size, dtype=np.uint8)
        is_empty[self._texel] = 0
        if len(self._texel):
            distance, label = cv2.distanceTransformWithLabels(
                is_empty.reshape(self._size, self._size), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
            )
            nearest = np.zeros(int(label.max()) + 1, dtype=np.int64)
            nearest[label.ravel()[self._texel]] = self._texel
            beside = np.flatnonzero((is_empty > 0) & (distance.ravel() <= 2.0 * GUTTER))
            picture[beside] = picture[nearest[label.ravel()[beside]]]
        return Textured(self._mesh, self._uv, picture.reshape(self._size, self._size, 3))


def _raw_pixels(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each pixel of an image without distortion, where it is in the recorded one, as (u, v), each (H, W) float32."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    raw = camera.distort(np.stack([u, v], axis=-1)).astype(np.float32)
    return np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])


def _mixed(of_corner: np.ndarray, share: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Interpolate what the corners (M, 3, D) of triangles have at places (N,) within them, `share` (N, 3) of each corner."""
    out = np.zeros((len(triangle), of_corner.shape[2]), dtype=np.float32)
    for k in range(3):
        out += share[:, k, None] * of_corner[triangle, k]
    return out


@kernel
def _own(uv: f4[:, :, ::1], owner: i4[:, ::1]):
    """Write to each texel (S, S) the triangle in which its centre lies."""
    size = owner.shape[0]
    for m in range(len(uv)):
        corners = _corners(uv, m, size)
        x0, y0, x1, y1, x2, y2 = corners
        area = _doubled_area(corners)
        if area == 0.0:
            continue
        for i in range(max(math.floor(min(y0, y1, y2)), 0), min(math.ceil(max(y0, y1, y2)) + 1, size)):
            for j in range(max(math.floor(min(x0, x1, x2)), 0), min(math.ceil(max(x0, x1, x2)) + 1, size)):
                a, b, c = _shares(j + 0.5, i + 0.5, corners, area)
                if a >= 0.0 and b >= 0.0 and c >= 0.0:
                    owner[i, j] = m


@kernel
def _weigh_corners(uv: f4[:, :, ::1], texel: i4[::1], first: i4[::1], size: i8, share: f4[:, ::1]):
    """Write the barycentric coordinates (N, 3) of texels (N,), sorted by their triangles, each with the rows from `first` (M + 1,) on."""
    for m in range(len(uv)):
        corners = _corners(uv, m, size)
        area = _doubled_area(corners)
        for n in range(first[m], first[m + 1]):
            a, b, c = _shares(texel[n] % size + 0.5, texel[n] // size + 0.5, corners, area)
            share[n, 0], share[n, 1], share[n, 2] = a, b, c


@kernel
def _corners(uv, m, size):
    """Return a triangle's corners x0 y0 x1 y1 x2 y2 [texels]."""
    scale = np.float64(size)
    return (
        scale * uv[m, 0, 0], scale * uv[m, 0, 1], scale * uv[m, 1, 0], scale * uv[m, 1, 1], scale * uv[m, 2, 0], scale * uv[m, 2, 1],
    )  # fmt: skip


@kernel
def _doubled_area(corners):
    """Return twice the signed area of a triangle [texels^2]."""
    x0, y0, x1, y1, x2, y2 = corners
    return (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)


@kernel
def _shares(x, y, corners, doubled_area):
    """Return the barycentric coordinates of a place in a triangle."""
    x0, y0, x1, y1, x2, y2 = corners
    b = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / doubled_area
    c = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / doubled_area
    return 1.0 - b - c, b, c


@kernel
def _add(surface: TexelSurface, shown: Shown, camera: Pinhole, paint: Paint):
    """Add to the texels the colours that a view has of them, times its weight."""
    first, corner, normal, xyz = surface
    rgb, depth, near, T, centre, quality = shown
    total, weight = paint
    fx, fy, cx, cy = camera
    height, width = depth.shape
    for m in range(len(first) - 1):
        if first[m] == first[m + 1]:
            continue
        ahead, left, right, up, down = 0, 0, 0, 0, 0
        for k in range(3):
            x, y, z = _moved(T, corner[m, k, 0], corner[m, k, 1], corner[m, k, 2])
            ahead += z > NEAREST
            left += fx * x < -cx * z
            right += fx * x > (width - cx) * z
            up += fy * y < -cy * z
            down += fy * y > (height - cy) * z
        if ahead < 3 or left == 3 or right == 3 or up == 3 or down == 3:
            continue
        for n in range(first[m], first[m + 1]):
            x, y, z = _moved(T, xyz[n, 0], xyz[n, 1], xyz[n, 2])
            u, v = fx * x / z + cx, fy * y / z + cy
            border = min(min(u, width - 1.0 - u), min(v, height - 1.0 - v))
            if border < 1.0:
                continue
            i, j = int(v + 0.5), int(u + 0.5)
            tolerance = TOLERANCE + TOLERANCE_GROWTH * z * z
            if abs(depth[i, j] - z) > tolerance or near[i, j] < z - tolerance:
                continue
            dx, dy, dz = centre[0] - xyz[n, 0], centre[1] - xyz[n, 1], centre[2] - xyz[n, 2]
            distance = math.sqrt(dx * dx + dy * dy + dz * dz)
            cosine = (dx * normal[m, 0] + dy * normal[m, 1] + dz * normal[m, 2]) / distance
            if cosine < LEAST_COSINE:
                continue
            good = quality * cosine / distance * min(border / (FEATHER * height), 1.0)
            good *= good * good
            w = good * good  # to the sixth power: a view half as good counts a 64th
            i, j = int(v), int(u)
            a, b = v - i, u - j
            for k in range(3):
                upper = (1.0 - b) * rgb[i, j, k] + b * rgb[i, j + 1, k]
                lower = (1.0 - b) * rgb[i + 1, j, k] + b * rgb[i + 1, j + 1, k]
                total[n, k] += w * ((1.0 - a) * upper + a * lower)
            weight[n] += w


@kernel
def _moved(T, x, y, z):
    """Return a point in the frame that T leads to."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )
