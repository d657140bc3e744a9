"""Which parts of each view move, seen with hindsight: places that later or earlier views look through.

Somebody walking before the camera hides one part of the room after the other. Wherever another view of the recording finds empty space in
the place of a surface, that surface has moved; no view ever looks through what stands still. Surfaces that other views find again long
before or after are still. From places surely moving a region grows over the connected surface up to what is surely still.

Views are compared as coarse depth images (depth/icp.py) under given poses of all frames, with the camera's distortion taken out.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from slamcli.depth import icp
from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.geometry.common_camera import Retelling
from slamcli.schema import Features
from slamcli.slam import moving_object_kernels as kernels

STEP = 2  # coarse pixels from one place looked at to the next
AFTER = (0.07, 0.14, 0.2, 0.35, 0.55, 0.8, 1.1)  # [s] before and after a view, of the views that it is compared with
LONG = 0.3  # [s] apart, from which on what is seen again in its place counts as still: a stride takes 0.5 s
MIN_STILL = 2  # views long before or after that find a place again where it is still
TOLERANCE = np.array([0.06, 0.02, 0.008])  # base [m], share of the depth, growth with its square [1/m]: poses err, readings too
SMOOTH = 0.06  # of the depth, by which neighbours of a place that is compared differ at most: readings at edges hang in the air
GROUP_JUMP, GROWTH_JUMP = 0.1, 0.05  # of the depth, between neighbouring places of one group and of one surface
GROWTH_MOST = 12  # places from one surely moving: more, and what is seen once only would be taken along
FOLLOWED = 0.8  # [s] before the end of the recording
ENCLOSED = 4  # of its eight neighbours move: so does a place without depth
MOST = 0.6  # of the surface seen [m^2]: when more seems to move, it is the pose that is wrong
MAP_MARGIN = 2  # places around what moves that maps leave out: other views show what stands there
QUICK_EVERY, QUICK_AFTER = 4, (0.35, 0.8)  # frames looked at first, and [s] as AFTER, to see whether anything moves at all
QUICK_SHARE, QUICK_FRAMES = 0.02, 2  # a recording has moving objects when this share of a view moves in so many of these frames
OUT_OF_SIGHT = -1e4  # [px] where no search looks


@dataclass(frozen=True)
class Views:
    """The coarse depth images of a recording and where they were taken."""

    depth: CoarseImages
    stamp: np.ndarray  # (F,) [s]
    T_wc: np.ndarray  # (F, 4, 4) camera to world, NaN = unknown
    world: np.ndarray  # (F,) which world a pose is in: those of two cannot be compared
    camera: Camera  # of the full images


@dataclass(frozen=True)
class Rule:
    """What counts as surely moving."""

    after: tuple[float, ...]  # [s] before and after a view, of the views that it is compared with
    min_through: int  # views that look through a place
    weight_still: float  # such views a place needs for each one that finds it again
    min_group: int  # connected places: less is noise along edges


# Poses may rest on what stands a while, but on nothing that moves. Maps show nothing that a later view looks through, and miss no view.
FOR_POSES = Rule(AFTER, min_through=1, weight_still=1.0, min_group=12)
FOR_MAPS = Rule((*AFTER, 2.0, 4.0, 8.0, 16.0), min_through=2, weight_still=0.15, min_group=4)


@dataclass(frozen=True)
class Evidence:
    """What other views say of the places (v, u) of one view."""

    depth: np.ndarray  # (v, u) float32 [m], 0 = unknown
    n_through: np.ndarray  # (v, u) views that look through the place
    n_still: np.ndarray  # (v, u) views at least LONG apart that find it again


def shape(camera: Camera) -> tuple[int, int]:
    """Return rows and columns of the camera's masks."""
    rows, columns = icp.coarse_shape(camera)
    return rows // STEP, columns // STEP


def is_any(views: Views) -> bool:
    """Say whether anything moves in a recording, after a look at some of its frames."""
    found = 0
    for frame in range(0, len(views.stamp), QUICK_EVERY):
        evidence = weigh(views, frame, QUICK_AFTER)
        if evidence is not None and _surely_moving(evidence, FOR_POSES).mean() > QUICK_SHARE:
            found += 1
    return found >= QUICK_FRAMES


def find(views: Views, progress: Callable[[range], Iterable[int]] = iter, *, rule: Rule = FOR_POSES) -> np.ndarray:
    """Find what moves in every view, (F, v, u) bool; nothing where its pose is unknown or contradicts most of what is seen.

    The last views have none after them that would look through what moves: there it is followed from the view before.
    """
    moving = np.zeros((len(views.stamp), *shape(views.camera)), dtype=bool)
    for frame in progress(range(len(moving))):
        is_followed = frame > 0 and views.stamp[-1] - views.stamp[frame] < FOLLOWED
        moving[frame] = _find_in(views, frame, moving[frame - 1] if is_followed else None, rule)
    return moving


def _find_in(views: Views, frame: int, before: np.ndarray | None, rule: Rule) -> np.ndarray:
    """Find what moves in one view, (v, u) bool; before : (v, u) what moves in the view before, if that is to be followed."""
    evidence = weigh(views, frame, rule.after)
    if evidence is None:
        return np.zeros(shape(views.camera), dtype=bool)
    z, seed = evidence.depth, _surely_moving(evidence, rule)
    is_still = (evidence.n_still >= MIN_STILL) & (evidence.n_through == 0)
    followed = np.zeros_like(seed) if before is None else _followed(views, frame, z, before) & ~is_still
    if not (seed | followed).any():
        return seed
    is_open = ~is_still & (z > 0)
    moving = kernels.grow(seed, is_open, z, GROWTH_JUMP, GROWTH_MOST) | kernels.grow(followed, is_open, z, GROWTH_JUMP, 1)
    area = z * z
    if area[moving].sum() > MOST * area.sum():
        return np.zeros_like(seed)
    around = cv2.boxFilter(moving.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_REPLICATE)
    return moving | ((around >= ENCLOSED) & (z == 0))  # outlines have no depth


def _followed(views: Views, frame: int, z: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Find the places (v, u) of a view that lie where something moved in the view before."""
    small, _ = icp.coarse_camera(views.camera)
    v, u = (STEP * index + STEP // 2 for index in np.indices(z.shape))
    x = small.backproject(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64), z.ravel())
    x = se3.transform(product(se3.inverse(views.T_wc[frame - 1]), views.T_wc[frame]), x)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = (np.stack([small.fx * x[:, 0], small.fy * x[:, 1]]) / x[:, 2] + [[small.cx], [small.cy]] + 0.5) // STEP
    inside = (x[:, 2] > 0) & (z.ravel() > 0) & (row >= 0) & (column >= 0) & (row < z.shape[0]) & (column < z.shape[1])
    out = np.zeros(z.size, dtype=bool)
    out[inside] = before[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    return out.reshape(z.shape)


def weigh(views: Views, frame: int, after: tuple[float, ...]) -> Evidence | None:
    """Compare a view with those `after` [s] before and after it; None where none can be compared."""
    others = _others(views, frame, after) if views.depth.size else np.zeros(0, dtype=np.int64)
    if len(others) == 0 or not np.isfinite(views.T_wc[frame, 0, 0]):
        return None
    middle, seen = seen_from(views, frame, others)
    is_long = np.abs(views.stamp[others] - views.stamp[frame]) >= LONG
    return Evidence(middle, (seen == kernels.THROUGH).sum(axis=0), (seen[is_long] == kernels.AGAIN).sum(axis=0))


def seen_from(views: Views, frame: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Look from other views (N,) at what one shows: depth (v, u) [m], 0 = unknown, and what each says of it, (N, v, u), as the kernel `compare` has it."""
    small, row_at = icp.coarse_camera(views.camera)
    place = np.where(row_at < small.width * small.height, row_at, -1).astype(np.int32)
    raw = np.append(views.depth[frame].ravel(), np.uint16(0))
    z = raw[place].astype(np.float32) * np.float32(icp.UNIT)  # -1 takes the 0 at the end
    T = np.ascontiguousarray(product(se3.inverse(views.T_wc[others]), views.T_wc[frame]))
    pinhole = np.array([small.fx, small.fy, small.cx, small.cy])
    seen = np.zeros((len(others), *shape(views.camera)), dtype=np.uint8)
    images = views.depth.of(others)
    kernels.compare(z, kernels.smooth_places(z, SMOOTH), STEP, images, place, T, pinhole, TOLERANCE, icp.UNIT, seen)
    rows, columns = seen.shape[1:]
    return np.ascontiguousarray(z[STEP // 2 :: STEP, STEP // 2 :: STEP][:rows, :columns]), seen


def _others(views: Views, frame: int, after: tuple[float, ...]) -> np.ndarray:
    """List the frames nearest to so many seconds before and after one, whose poses can be compared with its pose."""
    wanted = views.stamp[frame] + np.concatenate([-np.array(after), after])
    right = np.searchsorted(views.stamp, wanted).clip(1, max(len(views.stamp) - 1, 1))
    right = np.minimum(right, len(views.stamp) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(wanted - views.stamp[left] < views.stamp[right] - wanted, left, right)
    inside = (wanted >= views.stamp[0] - LONG) & (wanted <= views.stamp[-1] + LONG)
    others = np.unique(nearest[inside])
    usable = (others != frame) & np.isfinite(views.T_wc[others, 0, 0]) & (views.world[others] == views.world[frame])
    return others[usable]


def _surely_moving(evidence: Evidence, rule: Rule) -> np.ndarray:
    """Find the places that enough views look through, against those that find them again, in groups large enough."""
    seed = (evidence.n_through >= rule.min_through) & (evidence.n_through > rule.weight_still * evidence.n_still)
    return kernels.groups(seed, evidence.depth, GROUP_JUMP, rule.min_group)


def hide_features(features: Features, moving: np.ndarray, camera: Camera) -> Features:
    """Put the features that show what moves out of sight, so that no pose rests on them and no landmark is made of them.

    moving : (F, v, u) bool, or without rows where nothing moves
    """
    if len(moving) == 0:
        return features
    frame = np.repeat(np.arange(len(features.stamp)), np.diff(features.offset))
    side = _side(camera)
    row, column = ((features.xy[:, k] + 0.5) // side for k in (1, 0))
    row, column = row.astype(np.int64).clip(0, moving.shape[1] - 1), column.astype(np.int64).clip(0, moving.shape[2] - 1)
    is_moving = np.array([with_margin(mask) for mask in moving])[frame, row, column]
    xy, depth = np.array(features.xy), np.array(features.depth)
    xy[is_moving], depth[is_moving] = OUT_OF_SIGHT, np.nan
    return replace(features, xy=xy, depth=depth)


def hide_coarse(images: CoarseImages, moving: np.ndarray, camera: Camera) -> CoarseImages:
    """Remove what moves from the coarse depth images; `moving` as in `hide_features`."""
    if len(moving) == 0:
        return images
    small, _ = icp.coarse_camera(camera)
    lookup = _lookup(small, STEP, moving.shape[1:])

    def hide(frame: int, image: np.ndarray) -> np.ndarray:
        image[np.append(with_margin(moving[frame]).ravel(), False)[lookup]] = 0
        return image

    return images.changed(hide)


def hide_pixels(depth: np.ndarray, mask: np.ndarray, camera: Camera) -> np.ndarray:
    """Remove what moves from a depth image (H, W) [m]; mask : (v, u) bool."""
    return np.where(in_image(with_margin(mask, MAP_MARGIN), camera), np.float32(np.nan), depth)


def in_image(mask: np.ndarray, camera: Camera) -> np.ndarray:
    """Spread a mask (v, u) over the raw pixels (H, W) of an image."""
    return np.append(mask.ravel(), False)[_lookup(camera, _side(camera), mask.shape)]


def retold(moving: np.ndarray, own: Camera, common: Camera) -> np.ndarray:
    """Tell what moves in the views of camera `own`, (F, v, u) bool, in the blocks of camera `common` at the same place."""
    how = Retelling(common, own)
    if how.is_identity:
        return np.asarray(moving)
    rows, columns = shape(common)
    row, column = np.mgrid[0:rows, 0:columns]
    middle = (np.stack([column, row], axis=-1) + 0.5) * _side(common) - 0.5
    column, row = (how.pixels(middle)[..., k] + 0.5 for k in (0, 1))
    column, row = (np.floor(value / _side(own)).astype(np.int64) for value in (column, row))
    inside = (row >= 0) & (column >= 0) & (row < moving.shape[1]) & (column < moving.shape[2])
    return moving[:, np.where(inside, row, 0), np.where(inside, column, 0)] & inside


def with_margin(mask: np.ndarray, places: int = 1) -> np.ndarray:
    """Widen a mask (v, u) on all sides: outlines of what moves are found least surely, and features sit on outlines."""
    side = 2 * places + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool)


def _side(camera: Camera) -> int:
    """Return the side of a mask's place [px of the full image]."""
    return STEP * (camera.width // icp.coarse_shape(camera)[1])


@lru_cache(maxsize=4)
def _lookup(camera: Camera, side: int, places: tuple[int, ...]) -> np.ndarray:
    """Return the place of a mask that each raw pixel of an image shows, (H, W), -1 = none."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    xy = camera.undistort(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)).reshape(camera.height, camera.width, 2)
    column, row = ((xy[..., k] + 0.5) // side for k in (0, 1))
    inside = (row >= 0) & (column >= 0) & (row < places[0]) & (column < places[1])
    return np.where(inside, row * places[1] + column, -1).astype(np.int64)
