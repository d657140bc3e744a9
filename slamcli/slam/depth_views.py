"""Coarse depth images of a recording under known poses, and what one view says of the surfaces that another shows."""

from dataclasses import dataclass

import numpy as np

from slamcli.depth import icp
from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.slam import moving_object_kernels as kernels

STEP = 2  # coarse pixels from one place looked at to the next
TOLERANCE = np.array([0.06, 0.02, 0.008])  # base [m], share of the depth, growth with its square [1/m]: poses err, readings too
SMOOTH = 0.06  # of the depth, by which neighbours of a place that is compared differ at most: readings at edges hang in the air


@dataclass(frozen=True)
class Views:
    """The coarse depth images of a recording and where they were taken."""

    depth: CoarseImages
    stamp: np.ndarray  # (F,) [s]
    T_wc: np.ndarray  # (F, 4, 4) camera to world, NaN = unknown
    world: np.ndarray  # (F,) which world a pose is in: those of two cannot be compared
    camera: Camera  # of the full images


def shape(camera: Camera) -> tuple[int, int]:
    """Return rows and columns of the camera's masks, the places that are looked at."""
    rows, columns = icp.coarse_shape(camera)
    return rows // STEP, columns // STEP


def seen_from(views: Views, frame: int, others: np.ndarray, *, shown: CoarseImages | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Look from other views (N,) at what one shows: depth (v, u) [m], 0 = unknown, and what each says of it, (N, v, u), as the kernel `compare` has it.

    shown : what the others show, if not all of their depth
    """
    small, row_at = icp.coarse_camera(views.camera)
    place = np.where(row_at < small.width * small.height, row_at, -1).astype(np.int32)
    raw = np.append(views.depth[frame].ravel(), np.uint16(0))
    z = raw[place].astype(np.float32) * np.float32(icp.UNIT)  # -1 takes the 0 at the end
    T = np.ascontiguousarray(product(se3.inverse(views.T_wc[others]), views.T_wc[frame]))
    seen = np.zeros((len(others), *shape(views.camera)), dtype=np.uint8)
    looked_from = kernels.Others((views.depth if shown is None else shown).of(others), place, T, icp.UNIT)
    kernels.compare(z, kernels.smooth_places(z, SMOOTH), STEP, looked_from, _pinhole(views.camera), TOLERANCE, seen)
    rows, columns = seen.shape[1:]
    return np.ascontiguousarray(z[STEP // 2 :: STEP, STEP // 2 :: STEP][:rows, :columns]), seen


def follow(views: Views, depth: tuple[np.ndarray, np.ndarray], frames: tuple[int, int], value: tuple[np.ndarray, np.ndarray]) -> None:
    """Take values over from one view to another, whose places (v, u) see the same surface in the same place.

    depth, frames, value : of the view that has them, and of the one that gets them; depth (v, u) float32 [m], 0 = unknown;
        values NaN = none, those that are there already stay
    """
    T = np.ascontiguousarray(product(se3.inverse(views.T_wc[frames[0]]), views.T_wc[frames[1]]))
    if views.world[frames[0]] == views.world[frames[1]] and np.isfinite(T[0, 0]):
        kernels.follow(depth[1], depth[0], value[0], STEP, T, _pinhole(views.camera), TOLERANCE, value[1])


def _pinhole(camera: Camera) -> np.ndarray:
    small, _ = icp.coarse_camera(camera)
    return np.array([small.fx, small.fy, small.cx, small.cy])
