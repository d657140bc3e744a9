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
from slamcli.geometry.camera import Camera
from slamcli.geometry.common_camera import Retelling
from slamcli.schema import Features
from slamcli.slam import moving_object_kernels as kernels
from slamcli.slam import standing_objects
from slamcli.slam.depth_views import STEP, Views, seen_from, shape
from slamcli.slam.standing_objects import GROWTH_MOST, JUMP, MovingSightings, PlaceEvidence, n_around

AFTER = (0.07, 0.14, 0.2, 0.35, 0.55, 0.8, 1.1)  # [s] before and after a view, of the views that it is compared with
LATER, MUCH_LATER = (1.5, 2.0, 2.6, 3.3), (4.0, 5.0, 6.5, 8.0, 10.0, 13.0, 16.0)  # the same, for what waits, and for what is taken away
LONG = 0.3  # [s] apart, from which on what is seen again in its place counts as still: a stride takes 0.5 s
MIN_STILL = 2  # views long before or after that find a place again where it is still
GROUP_JUMP = 0.1  # of the depth, between neighbouring places of one group
SPREAD_JUMP = 0.015  # of the depth, between neighbouring places that it spreads over: less than the floor's slant
SPREAD_MOST = 30  # places that it spreads
SPREAD_ROUNDS = 2  # each finds again less of what moves
OUTLINE, ENCLOSED = 3, 4  # of its eight neighbours move: so does a place without depth, beside the background and elsewhere
MOST = 0.6  # of the surface seen [m^2]: when more seems to move, it is the pose that is wrong
MAP_MARGIN = 2  # places around what moves that maps leave out: other views show what stands there
QUICK_EVERY, QUICK_AFTER = 4, (0.35, 0.8)  # frames looked at first, and [s] as AFTER, to see whether anything moves at all
# A recording has moving objects when this share of a view moves in so many of these frames, no farther apart than so many seconds: what
# moves is in view for a while, and single frames that only seem to show it, one in hundreds, come together in any long recording.
QUICK_SHARE, QUICK_FRAMES, QUICK_SPAN = 0.02, 2, 1.0
OUT_OF_SIGHT = -1e4  # [px] where no search looks


@dataclass(frozen=True)
class Rule:
    """What counts as surely moving."""

    after: tuple[float, ...]  # [s] before and after a view, of the views that it is compared with
    min_through: int  # views that look through a place
    weight_still: float  # such views a place needs for each one that finds it again
    min_group: int  # connected places: less is noise along edges
    followed: float  # [s] before it goes, and after it came, over which what moves is recognized where it stands
    spreads: bool = False  # over what is connected with it and nothing still confirms some time apart


# Whether anything moves is asked of every recording, and poses that err are not to answer it.
AT_ALL = Rule(QUICK_AFTER, min_through=1, weight_still=1.0, min_group=12, followed=0.0)
# Poses that drift agree about views that are near in time only.
UNDER_DRIFT = Rule(AFTER, min_through=1, weight_still=0.3, min_group=12, followed=1.0)
# Poses may rest on what stands a while, but on nothing that moves. Maps show nothing that a later view looks through, and miss no view.
FOR_POSES = Rule((*AFTER, *LATER), min_through=1, weight_still=1.0, min_group=12, followed=4.0)
FOR_MAPS = Rule((*AFTER, *LATER, *MUCH_LATER), min_through=1, weight_still=0.15, min_group=4, followed=np.inf, spreads=True)


def is_any(views: Views) -> bool:
    """Say whether anything moves in a recording, after a look at some of its frames."""
    found: list[float] = []
    for frame in range(0, len(views.stamp), QUICK_EVERY):
        evidence = weigh(views, frame, AT_ALL.after)
        if evidence is not None and _surely_moving(evidence, AT_ALL).mean() > QUICK_SHARE:
            found.append(float(views.stamp[frame]))
            if len(found) >= QUICK_FRAMES and found[-1] - found[-QUICK_FRAMES] <= QUICK_SPAN:
                return True
    return False


def find(views: Views, progress: Callable[[range], Iterable[int]] = iter, *, rule: Rule = FOR_POSES) -> np.ndarray:
    """Find what moves in every view, (F, v, u) bool; nothing where its pose is unknown or contradicts most of what is seen.

    What moves in one view is followed to the views before and after it, to where it stands.
    """
    sightings = MovingSightings.none(len(views.stamp), shape(views.camera))
    for frame in progress(range(len(views.stamp))):
        evidence = weigh(views, frame, rule.after)
        if evidence is not None:
            sightings.note(frame, evidence, *_find_in(evidence, rule))
    moving = standing_objects.follow(views, sightings, most=rule.followed)
    for frame, found in enumerate(moving):
        if _is_most(found, sightings.z(frame)):
            found[:] = sightings.is_moving[frame]
    if rule.spreads and moving.any():
        moving = spread(views, moving, rule.after)
    for frame, found in enumerate(moving):
        found |= _outline(found, sightings.z(frame))
    return moving


def spread(views: Views, moving: np.ndarray, after: tuple[float, ...]) -> np.ndarray:
    """Add to what moves, (F, v, u) bool, the surface that hangs together with it and that nothing still in a view some time apart shows again.

    after : as of `Rule`
    Legs near by leave the picture before any view looks through them, and other legs come to where they were.
    """
    for _ in range(SPREAD_ROUNDS):
        still, found = hide_coarse(views.depth, moving, views.camera), moving.copy()
        for frame in np.flatnonzero(moving.any(axis=(1, 2))).tolist():
            evidence = weigh(views, frame, after, shown=still)
            if evidence is not None:
                is_open = (evidence.depth > 0) & (evidence.n_still == 0)
                found[frame] = kernels.grow(moving[frame], is_open, evidence.depth, SPREAD_JUMP, SPREAD_MOST)
        moving = found
    return moving


def _find_in(evidence: PlaceEvidence, rule: Rule) -> tuple[np.ndarray, np.ndarray]:
    """Find what surely moves in one view, (v, u) bool, by what other views say of it, and all that moves with it."""
    z, seed = evidence.depth, _surely_moving(evidence, rule)
    is_still = (evidence.n_still >= MIN_STILL) & (evidence.n_through == 0)
    moving = kernels.grow(seed, ~is_still & (z > 0), z, JUMP, GROWTH_MOST) if seed.any() else seed
    return (np.zeros_like(seed), np.zeros_like(seed)) if _is_most(moving, z) else (seed, moving)


def _is_most(moving: np.ndarray, z: np.ndarray) -> bool:
    """Say whether more of the surface seen moves than can be believed."""
    area = z * z
    return bool(area[moving].sum() > MOST * area.sum())


def _outline(moving: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Find the places (v, u) without depth that belong to what moves: between it and the background; its shadow in the pattern is wider."""
    n_moving, n_still = (n_around(places) for places in (moving, ~moving & (z > 0)))
    return (z == 0) & (n_moving >= np.where(n_still > 0, OUTLINE, ENCLOSED))


def weigh(views: Views, frame: int, after: tuple[float, ...], *, shown: CoarseImages | None = None) -> PlaceEvidence | None:
    """Compare a view with those `after` [s] before and after it, of which `shown` is to be seen; None where none can be compared."""
    others = _others(views, frame, after) if views.depth.size else np.zeros(0, dtype=np.int64)
    if len(others) == 0 or not np.isfinite(views.T_wc[frame, 0, 0]):
        return None
    middle, seen = seen_from(views, frame, others, shown=shown)
    apart, is_again = views.stamp[others] - views.stamp[frame], seen == kernels.AGAIN
    when = np.where(is_again, apart.astype(np.float32)[:, None, None], np.float32(0.0))
    return PlaceEvidence(
        depth=middle,
        n_through=(seen == kernels.THROUGH).sum(axis=0),
        n_still=is_again[np.abs(apart) >= LONG].sum(axis=0),
        since=when.min(axis=0, initial=0.0),
        until=when.max(axis=0, initial=0.0),
    )


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


def _surely_moving(evidence: PlaceEvidence, rule: Rule) -> np.ndarray:
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


def is_hidden(features: Features) -> np.ndarray:
    """Say which features (M,) `hide_features` put out of sight."""
    return features.xy[:, 0] == np.float32(OUT_OF_SIGHT)


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
