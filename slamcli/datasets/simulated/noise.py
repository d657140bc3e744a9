"""What a structured-light camera such as the first Kinect makes of exact images."""

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.geometry.camera import Camera

PATCH = 0.4  # [m] side of a patch of surface that gives no reading
HASH = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], dtype=np.uint64)  # odd; spread bits


@dataclass(frozen=True)
class SensorNoise:
    """Depth and colour noise; the defaults are a Kinect's."""

    axial_base: float = 0.0012  # [m] sigma_z = base + quadratic (z - 0.4)^2; Nguyen, Izadi, Lovell, 3DIMPVT 2012
    axial_quadratic: float = 0.0019  # [1/m]
    baseline: float = 0.075  # [m] between projector and infrared camera
    disparity_focal: float = 580.0  # [px] of the infrared camera
    disparity_step: float = 0.125  # [px]
    lateral: float = 0.4  # [px] sigma of the place a reading is taken at: frays edges
    edge: float = 0.04  # relative jump of depth between neighbours at 640 px width, beyond which the reading is lost
    grazing: float = 0.13  # cosine of incidence below which no light comes back
    near: float = 0.4  # [m]
    far: float = 5.0  # [m]
    colour: float = 1.6  # [grey levels] sigma
    blur: float = 0.45  # [px] sigma of the lens


class NormalNoise:
    """Normal noise images cut at random places out of one large one: drawing fresh ones would cost as much as ray casting."""

    MARGIN = 400  # [px] how far apart the cuts can lie

    def __init__(self, shape: tuple[int, int], seed: int) -> None:
        self._shape = shape
        self._large = np.random.default_rng([seed, 4]).standard_normal([n + self.MARGIN for n in shape], dtype=np.float32)

    def cut(self, rng: np.random.Generator) -> np.ndarray:
        """Return (H, W) float32, mean 0, variance 1."""
        row, column = rng.integers(0, self.MARGIN, 2)
        return self._large[row : row + self._shape[0], column : column + self._shape[1]]


def depth_noise(
    depth: np.ndarray, cosine: np.ndarray, focal: float, noise: SensorNoise, normal_noise: NormalNoise, rng: np.random.Generator
) -> np.ndarray:
    """Return noisy depth (H, W) float32 [m], 0 where there is no reading.

    depth : (H, W) float32 [m], exact
    cosine : (H, W) float32, of the angle between ray and surface normal
    focal : [px] of the depth image
    """
    shape = depth.shape
    normal = [normal_noise.cut(rng) for _ in range(3)]
    fray = np.float32(noise.lateral)
    columns, rows = np.meshgrid(np.arange(shape[1], dtype=np.float32), np.arange(shape[0], dtype=np.float32))
    z = cv2.remap(depth, columns + fray * normal[0], rows + fray * normal[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    # Neighbouring readings share most of their correlation window: the noise is smoothed, its variance kept.
    axial = cv2.GaussianBlur(normal[2], (0, 0), 0.8) * np.float32(2 * np.sqrt(np.pi) * 0.8)
    z = z + axial * (noise.axial_base + noise.axial_quadratic * (z - 0.4) ** 2).astype(np.float32)
    focal_baseline = np.float32(noise.baseline * noise.disparity_focal / noise.disparity_step)
    steps = np.round(focal_baseline / np.maximum(z, np.float32(1e-3)))
    z = focal_baseline / np.maximum(steps, np.float32(1.0))
    lost = (
        in_projector_shadow(depth, focal * noise.baseline)
        | _at_edge(depth, noise.edge * 525.0 / focal)
        | (cosine < noise.grazing * (1 + 0.3 * normal[0]))
    )
    return np.where(lost | (z < noise.near) | (z > noise.far), np.float32(0.0), z)


def without_reading(depth: np.ndarray, T_lc: np.ndarray, camera: Camera, *, share: float, seed: int) -> np.ndarray:
    """Find the pixels (H, W) that show glass, black or shiny surface, which gives no reading: patches fixed in space, `share` of all.

    depth : (H, W) float32 [m], exact
    """
    x, y = camera.rays[..., 0] * depth, camera.rays[..., 1] * depth
    xyz = np.stack([x, y, depth], axis=-1) @ T_lc[:3, :3].T.astype(np.float32) + T_lc[:3, 3].astype(np.float32)
    # Moved by a part of a cell, as floor and walls lie at whole multiples.
    cell = np.floor(xyz / np.float32(PATCH) + np.float32(0.37)).astype(np.int64).astype(np.uint64)
    mixed = (cell * HASH[:3]).sum(axis=-1) + np.array([seed + 1], dtype=np.uint64) * HASH[3]
    mixed = (mixed ^ (mixed >> np.uint64(29))) * HASH[3]
    return (mixed >> np.uint64(40)).astype(np.float64) < share * 2.0**24


def in_projector_shadow(depth: np.ndarray, focal_baseline: float) -> np.ndarray:
    """Find the pixels that the projector, to the right of the camera, cannot light: those behind something nearer to their right.

    In the projector's image a point lies focal_baseline / z [px] further to the left; where a pixel further right in the camera's row
    has come to lie left of it, that nearer surface is in the way.
    """
    column = np.arange(depth.shape[1], dtype=np.float32) - np.float32(focal_baseline) / np.maximum(depth, np.float32(1e-3))
    leftmost = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return column > leftmost + 1.0


def _at_edge(depth: np.ndarray, relative: float) -> np.ndarray:
    """Find pixels with a jump of depth to a neighbour."""
    kernel = np.ones((3, 3), dtype=np.uint8)
    return cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > relative * depth


def colour_noise(rgb: np.ndarray, noise: SensorNoise, normal_noise: NormalNoise, rng: np.random.Generator) -> np.ndarray:
    """Blur (H, W, 3) float32 as a lens does and add sensor noise; returns uint8."""
    soft = cv2.GaussianBlur(rgb, (0, 0), noise.blur) if noise.blur > 0 else rgb
    if noise.colour > 0:
        soft = soft + np.float32(noise.colour) * normal_noise.cut(rng)[..., None]
    return np.clip(soft + 0.5, 0, 255).astype(np.uint8)
