"""Surface patches: key frames' depth reduced to few points with normals, from which the floor is found."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slamcli.geometry import depth_noise, se3
from slamcli.geometry.algebra import eigh, product
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_noise import DepthNoise

# Depth within one patch [m, share of the depth]: a floor seen at a flat angle spans much, so the bound is wide; it only rejects edges.
SPREAD, SPREAD_SHARE = 0.02, 0.1
JUMP = 0.15  # of the depth, between the patches to either side of one: more, and they show two things
SMOOTHED = 1e-3  # [m] below which distances to a plane count as squares
MAX_FRAMES = 256  # key frames kept; of more, every second one goes: bounds memory, and a floor needs no more


@dataclass(frozen=True)
class Patches:
    """Small surface pieces of all key frames: blocks of pixels averaged to one point, with a normal."""

    xyz: np.ndarray  # (N, 3) m, world
    normal: np.ndarray  # (N, 3) unit, world, towards the camera; NaN where the neighbours give none
    sigma: np.ndarray  # (N,) m, of the point along its ray
    frame: np.ndarray  # (N,) int32, row in T_wk
    grid: np.ndarray  # (N, 2) int32, row and column of the block
    shape: tuple[int, int]  # rows and columns of blocks in an image


@dataclass(frozen=True)
class Support:
    """A plane and what speaks for it."""

    plane: np.ndarray  # (4,) unit normal and offset, world
    inliers: np.ndarray  # (M,) rows of Patches
    n_candidates: int  # patches the inliers were chosen from


def collect(
    frames: Iterable[tuple[np.ndarray, np.ndarray]], camera: Camera, *, side: int, max_range: float, noise: DepthNoise
) -> tuple[Patches, np.ndarray]:
    """Reduce each key frame to surface patches in the world frame; returns Patches and the T_wk (F, 4, 4) kept.

    noise : of a single reading, which a patch is believed to have: readings side by side err together
    """
    rays = camera.rays
    shape = (camera.height // side, camera.width // side)
    kept: list[tuple] = []
    step = 1
    for i, (depth, T_wk) in enumerate(frames):
        if i % step or not np.isfinite(T_wk).all():
            continue
        kept.append((_patches(depth, rays, T_wk, side, max_range, noise), T_wk))
        if len(kept) >= MAX_FRAMES:
            kept, step = kept[::2], 2 * step
    if not kept:
        empty = np.zeros((0, 3))
        return Patches(empty, empty, np.zeros(0), np.zeros(0, np.int32), np.zeros((0, 2), np.int32), shape), np.zeros((0, 4, 4))
    columns = [np.concatenate([row[0][j] for row in kept]) for j in range(4)]
    frame = np.repeat(np.arange(len(kept), dtype=np.int32), [len(row[0][0]) for row in kept])
    return Patches(columns[0], columns[1], columns[2], frame, columns[3], shape), np.stack([row[1] for row in kept])


def _patches(depth: np.ndarray, rays: np.ndarray, T_wk: np.ndarray, side: int, max_range: float, noise: DepthNoise) -> tuple:
    blocks = _block_points(depth, rays, side, max_range, noise)
    normal_k = _normals(blocks)
    rows, columns = np.nonzero(np.isfinite(blocks[..., 2]))
    at = blocks[rows, columns].astype(np.float64)
    normal_w = se3.rotate(T_wk[:3, :3], normal_k[rows, columns])
    return se3.transform(T_wk, at[:, :3]), normal_w, at[:, 3], np.stack([rows, columns], axis=1).astype(np.int32)


def _block_points(depth: np.ndarray, rays: np.ndarray, side: int, max_range: float, noise: DepthNoise) -> np.ndarray:
    """Average up to 4 x 4 pixels of each `side` x `side` block to a point x y z and its depth's sigma (R, C, 4).

    NaN where the patch spans a depth discontinuity.

    Inverse depth is averaged: on a plane it is linear in the pixel, so that the mean lies on the plane at the pixels' mean ray.
    """
    z = _samples(depth, side).astype(np.float64)
    has = (z > 0.0) & (z <= max_range)
    z[~has] = np.nan
    n = has.sum(axis=0)
    low, high = np.fmin.reduce(z, axis=0), np.fmax.reduce(z, axis=0)
    is_one = (2 * n >= len(z)) & (high - low <= SPREAD + SPREAD_SHARE * low)
    n, has = n[is_one], has[:, is_one]
    z = n / np.where(has, 1.0 / z[:, is_one], 0.0).sum(axis=0)
    x, y = (z * np.where(has, _samples(rays[..., k], side)[:, is_one], 0.0).sum(axis=0, dtype=np.float64) / n for k in range(2))
    out = np.full((*is_one.shape, 4), np.nan, dtype=np.float32)
    out[is_one] = np.column_stack([x, y, z, depth_noise.sigmas(z, noise)])
    return out


def _samples(image: np.ndarray, side: int) -> np.ndarray:
    """Return up to 4 x 4 pixels (S, R, C) of each block of an image (H, W)."""
    rows, columns = image.shape[0] // side, image.shape[1] // side
    step = (side + 3) // 4
    per_side = -(-side // step)
    blocks = image[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return blocks[:, ::step, :, ::step].transpose(1, 3, 0, 2).reshape(per_side * per_side, rows, columns)


def _normals(points: np.ndarray) -> np.ndarray:
    """Return unit normals (R, C, 3) towards the camera by central differences over the blocks' points; NaN at edges and jumps of depth."""
    out = np.full((*points.shape[:2], 3), np.nan)
    middle = points[1:-1, 1:-1, :3]
    a = points[1:-1, 2:, :3] - points[1:-1, :-2, :3]
    b = points[2:, 1:-1, :3] - points[:-2, 1:-1, :3]
    normal = np.cross(b, a)
    length = np.sqrt(np.einsum("rck,rck->rc", normal, normal))
    reach = JUMP * middle[..., 2]
    is_smooth = (np.abs(a[..., 2]) < reach) & (np.abs(b[..., 2]) < reach) & (length > 0.0)
    faces_away = (normal * middle).sum(axis=-1) > 0.0
    length = np.where(faces_away, -length, length)
    out[1:-1, 1:-1][is_smooth] = normal[is_smooth] / length[is_smooth][:, None]
    return out


def fit_plane(xyz: np.ndarray, weight: np.ndarray, start: np.ndarray, *, rounds: int = 5) -> np.ndarray:
    """Minimize the weighted sum of distances of points (N, 3) to a plane (4,), [L] (18), by re-weighted least squares."""
    plane = start
    for _ in range(rounds):
        residual = np.abs(product(xyz, plane[:3]) + plane[3])
        w = weight / np.maximum(residual, SMOOTHED)  # sum w r^2 is then the sum of distances
        w = w / w.sum()
        mean = product(w, xyz)
        centred = xyz - mean
        normal = eigh(product((centred * w[:, None]).T, centred))[1][:, 0]
        normal = normal if product(normal, start[:3]) > 0.0 else -normal
        plane = np.append(normal, product(-normal, mean))
    return plane
