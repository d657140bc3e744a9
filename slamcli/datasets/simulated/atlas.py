"""Pictures of all patches in one atlas: painted, lit, in mip levels.

Light is computed once, as a coarse picture of each patch (lamps with soft shadows, ambient occlusion), and multiplied into its texture.
"""

from typing import Any, NamedTuple
from zlib import crc32

import cv2
import numpy as np

from slamcli.datasets.simulated.scene import Patch, Scene
from slamcli.open3d_loader import load_open3d

PACK = np.array([1, 1 << 8, 1 << 16], dtype=np.uint32)


class Atlas(NamedTuple):
    """Planes and pictures of Q patches, for points (x, 1) of one frame."""

    plane: np.ndarray  # (Q, 4) n, d with n . x + d = 0
    to_u: np.ndarray  # (Q, 4) texel column = to_u . (x, 1) at level 0, texel centres at whole numbers
    to_v: np.ndarray  # (Q, 4) texel row
    level: np.ndarray  # (Q + 1,) int64, rows of `size` and `start` of a patch's mip levels
    size: np.ndarray  # (S, 2) int64, rows and columns of a level
    start: np.ndarray  # (S,) int64, its first texel
    texel: np.ndarray  # (N,) uint32, red + green << 8 + blue << 16: one load instead of three

    def in_frame(self, T: np.ndarray) -> "Atlas":
        """Return the atlas for points of another frame, from which T (4, 4) leads to this one."""
        return self._replace(plane=self.plane @ T, to_u=self.to_u @ T, to_v=self.to_v @ T)


def bake_light(patches: list[Patch], scene: Scene, raycasting: Any, texel: float) -> list[np.ndarray]:
    """Compute how bright each patch is, a coarse (h, w) float32 picture apiece, 1 on average.

    Lamps shine by cos cos / distance^2 where nothing is in between, four sample points each; ambient light is dimmed by what lies
    within 0.7 m.
    """
    o3d = load_open3d()
    shapes = [(max(2, round(np.linalg.norm(p.b) / texel)), max(2, round(np.linalg.norm(p.a) / texel))) for p in patches]
    points, normals = [], []
    for patch, (h, w) in zip(patches, shapes, strict=True):
        u, v = np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h)
        normal = -np.cross(patch.a, patch.b)
        normal /= np.linalg.norm(normal)
        points.append(patch.origin + u.reshape(-1, 1) * patch.a + v.reshape(-1, 1) * patch.b + 2e-3 * normal)
        normals.append(np.broadcast_to(normal, (h * w, 3)))
    x, n = np.concatenate(points), np.concatenate(normals)

    def is_blocked(direction: np.ndarray, far: float) -> np.ndarray:
        packed = np.concatenate([x, direction], axis=1).astype(np.float32)
        return raycasting.test_occlusions(o3d.core.Tensor.from_numpy(packed), tnear=0.0, tfar=far).numpy()

    direct = np.zeros(len(x))
    corners = 0.2 * np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]])
    for lamp in scene.lamps - [0.0, 0.0, 0.03]:
        for corner in corners:
            to_lamp = lamp + corner - x
            d2 = np.einsum("ij,ij->i", to_lamp, to_lamp)
            facing = np.maximum(np.einsum("ij,ij->i", n, to_lamp), 0.0) * np.maximum(to_lamp[:, 2], 0.0) / (d2 * d2)
            useful = facing > 1e-3
            direct += np.where(useful & ~is_blocked(to_lamp, 0.999), facing, 0.0)
    hemisphere = _directions(14)
    open_ = np.zeros(len(x))
    weight = np.zeros(len(x))
    for direction in hemisphere:
        cosine = np.maximum(n @ direction, 0.0)
        open_ += cosine * ~is_blocked(np.broadcast_to(0.7 * direction, x.shape), 1.0)
        weight += cosine
    ambient = 0.55 + 0.3 * np.maximum(-n[:, 2], 0.0)  # what looks down is lit by the floor
    light = ambient * open_ / np.maximum(weight, 1e-9) + 0.6 * direct / (0.6 * direct.mean() + 0.4 * np.median(direct) + 1e-9)
    light = np.clip(light / light.mean(), 0.0, 2.2) ** 0.5  # pictures are in display values, not in linear light
    out, at = [], 0
    for h, w in shapes:
        out.append(cv2.GaussianBlur(light[at : at + h * w].reshape(h, w).astype(np.float32), (3, 3), 0.7))
        at += h * w
    return out


def build_atlas(patches: list[Patch], light: list[np.ndarray], seed: int, scale: float) -> Atlas:
    """Paint every patch at `scale` pixels per metre, multiply the light in and make the mip levels."""
    plane: list[np.ndarray] = []
    to_u: list[np.ndarray] = []
    to_v: list[np.ndarray] = []
    level, size, start, texels, at = [0], [], [], [], 0
    wide: dict[tuple[str, str], np.ndarray] = {}
    for patch, bright in zip(patches, light, strict=True):
        image = _picture(patch, seed, scale, wide)
        h, w = (max(n, m) for n, m in zip(image.shape[:2], bright.shape, strict=True))
        if (h, w) != image.shape[:2]:  # a plain colour needs pixels enough to show the shading
            image = cv2.resize(image, (w, h), interpolation=cv2.INTER_NEAREST)
        lit = image * cv2.resize(bright, (w, h), interpolation=cv2.INTER_LINEAR)[..., None]
        image = np.clip(0.86 * lit + 0.5, 0, 255).astype(np.uint8)
        normal = -np.cross(patch.a, patch.b)
        normal /= np.linalg.norm(normal)
        plane.append(np.append(normal, -normal @ patch.origin))
        for rows, edge, n in ((to_u, patch.a, w), (to_v, patch.b, h)):
            gradient = edge / (edge @ edge) * n
            rows.append(np.append(gradient, -gradient @ patch.origin - 0.5))
        while True:
            size.append(image.shape[:2])
            start.append(at)
            texels.append(image.reshape(-1, 3).astype(np.uint32) @ PACK)
            at += image.shape[0] * image.shape[1]
            if max(image.shape[:2]) == 1:
                break
            half = (max(1, (image.shape[1] + 1) // 2), max(1, (image.shape[0] + 1) // 2))
            image = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
        level.append(len(size))
    return Atlas(
        np.array(plane), np.array(to_u), np.array(to_v), np.array(level, dtype=np.int64), np.array(size, dtype=np.int64),
        np.array(start, dtype=np.int64), np.concatenate(texels),
    )  # fmt: skip


def _picture(patch: Patch, seed: int, scale: float, wide: dict[tuple[str, str], np.ndarray]) -> np.ndarray:
    rng = np.random.default_rng([seed, crc32("/".join(patch.key).encode())])
    width, height = float(np.linalg.norm(patch.a)), float(np.linalg.norm(patch.b))
    if not patch.picture_width:
        return patch.painter(rng, width, height, scale)
    if patch.key not in wide:
        wide[patch.key] = patch.painter(rng, patch.picture_width, height, scale)
    image = wide[patch.key]
    first, last = (round(share * image.shape[1]) for share in patch.columns)
    return image[:, min(first, image.shape[1] - 1) : max(last, first + 1)]


def _directions(n: int) -> np.ndarray:
    """Spread n unit vectors evenly over the sphere (Fibonacci lattice)."""
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(n)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
