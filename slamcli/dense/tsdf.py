"""A surface by volumetric integration, with Open3D: B. Curless and M. Levoy, SIGGRAPH 1996, doi:10.1145/237170.237269."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slamcli.depth.oriented_points import Surface
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.open3d_loader import load_open3d

BLOCK = 8  # voxels per side of the blocks that Open3D reserves; 16, its own default, takes twice the memory around thin surfaces
BLOCK_BYTES = BLOCK**3 * 12  # distance, weight and colour of each voxel
MAX_BLOCKS = 360_000  # 2 GiB, twice that while the table grows
TRUNCATION = 4.0  # voxels on either side of the surface
MIN_WEIGHT = 1.0  # readings that a voxel needs to be part of the surface


@dataclass(frozen=True)
class Mesh:
    """Triangles with coloured vertices."""

    xyz: np.ndarray  # (N, 3) float32 [m]
    rgb: np.ndarray  # (N, 3) uint8
    normal: np.ndarray  # (N, 3) float32, unit, out of the surface
    triangle: np.ndarray  # (M, 3) int32, vertex rows, counter-clockwise seen from outside

    def moved(self, T_ab: np.ndarray) -> "Mesh":
        """Return the mesh of frame b in frame a."""
        xyz = se3.transform(T_ab, self.xyz.astype(np.float64)).astype(np.float32)
        return Mesh(xyz, self.rgb, se3.rotate(T_ab[:3, :3], self.normal).astype(np.float32), self.triangle)


class Volume:
    """A truncated signed distance field over the voxels near surfaces."""

    def __init__(self, camera: Camera, *, voxel: float, depth_max: float) -> None:
        """Start empty; `voxel` is the voxels' side, farther readings than `depth_max` are ignored [m]."""
        self._o3d = load_open3d()
        core = self._o3d.core
        self._camera, self._voxel, self._depth_max = camera, float(voxel), float(depth_max)
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(core.float32, core.uint16, core.uint16),
            attr_channels=((1,), (1,), (3,)),
            voxel_size=float(voxel),
            block_resolution=BLOCK,
            block_count=4096,
        )
        self._K = core.Tensor(camera.K)
        # Open3D knows no lens distortion: its images are looked up at the raw pixels.
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        raw = camera.distort(np.stack([u, v], axis=-1)).astype(np.float32)
        self._raw_u, self._raw_v = np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])

    def add(self, seen: Surface, rgb: np.ndarray, T_wc: np.ndarray) -> None:
        """Integrate what one key frame saw; `seen` at stride 1, `rgb` (H, W, 3) uint8."""
        depth = np.zeros(rgb.shape[:2], dtype=np.float32)
        depth.reshape(-1)[seen.pixel] = seen.xyz_c[:, 2]
        if not depth.any():
            return
        image = self._o3d.t.geometry.Image
        depth_image = image(cv2.remap(depth, self._raw_u, self._raw_v, cv2.INTER_NEAREST))
        colour = image(cv2.remap(rgb.astype(np.float32) / 255.0, self._raw_u, self._raw_v, cv2.INTER_LINEAR))
        T_cw = self._o3d.core.Tensor(se3.inverse(T_wc))
        where = self._grid.compute_unique_block_coordinates(depth_image, self._K, T_cw, 1.0, self._depth_max, TRUNCATION)
        self._grid.integrate(where, depth_image, colour, self._K, T_cw, 1.0, self._depth_max, TRUNCATION)
        if self._grid.hashmap().size() > MAX_BLOCKS:
            raise SlamError(
                f"a surface of {self._voxel:g} m voxels would fill more than {MAX_BLOCKS * BLOCK_BYTES >> 30} GiB of memory; make the voxels larger"
            )

    def mesh(self) -> Mesh:
        """Extract the surface: W. Lorensen and H. Cline, Marching cubes, SIGGRAPH 1987, doi:10.1145/37401.37422."""
        nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
        if self._grid.hashmap().size() == 0:  # Open3D's own error would not say why
            return nothing
        found = self._grid.extract_triangle_mesh(weight_threshold=MIN_WEIGHT)
        return _in_order(found) if "positions" in found.vertex and len(found.vertex["positions"]) else nothing


def _in_order(found: Any) -> Mesh:
    """Sort vertices and triangles: Open3D's threads leave them in another order each time."""
    xyz, colour, normal = (found.vertex[name].numpy() for name in ("positions", "colors", "normals"))
    order = np.lexsort(xyz.T)
    place = np.empty(len(xyz), dtype=np.int32)
    place[order] = np.arange(len(xyz), dtype=np.int32)
    triangle = place[found.triangle["indices"].numpy()]
    turn = (np.arange(3) + triangle.argmin(axis=1)[:, None]) % 3  # the smallest row first; the sense of rotation stays
    triangle = np.take_along_axis(triangle, turn, axis=1)
    triangle = triangle[np.lexsort(triangle.T[::-1])]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return Mesh(
        xyz=xyz[order],
        rgb=np.clip(np.rint(colour[order] * 255.0), 0, 255).astype(np.uint8),
        normal=(normal / np.where(length > 0, length, 1.0))[order].astype(np.float32),
        triangle=np.ascontiguousarray(triangle),
    )
