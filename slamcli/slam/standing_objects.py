"""What moves, recognized while it stands: somebody who waits and then walks on, a box that is put down.

While it stands nothing tells it from furniture. But it is seen in one place up to the view in which it goes, and no view finds it there
afterwards; furniture beside it is found again. So what moves is followed from view to view over what they see in the same place, backwards
in time from where it went and forwards from where it came, as long as no view finds it again beyond that moment.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.slam import depth_views
from slamcli.slam import moving_object_kernels as kernels
from slamcli.slam.depth_views import Views

GONE = 0.35  # [s] after what moves is last seen in its place, from which on nothing of it may be found there again
GROWTH_MOST = (
    6  # places from one surely moving that move along, and that it goes from at about the same time: more, and floor is taken along
)
JUMP = 0.05  # of the depth, between neighbouring places of one surface
THICK, LEAST = 4, 30  # of nine places, and connected places, that are followed: fewer are edges of what stands beside
FILLED = 5  # of its eight neighbours move, on one surface with it: so does a place
FILL_ROUNDS = 3


@dataclass(frozen=True)
class PlaceEvidence:
    """What other views say of the places (v, u) of one view."""

    depth: np.ndarray  # (v, u) float32 [m], 0 = unknown
    n_through: np.ndarray  # (v, u) views that look through the place
    n_still: np.ndarray  # (v, u) views some time apart that find it again
    since: np.ndarray  # (v, u) float32 [s] after this view, at most 0: the first view that finds it again
    until: np.ndarray  # (v, u) float32 [s] after this view, at least 0: the last


@dataclass(frozen=True)
class MovingSightings:
    """The evidence of all views that following needs, and what it says, (F, v, u) each."""

    depth: np.ndarray  # float16 [m], 0 = unknown
    since: np.ndarray  # float16 [s] as in PlaceEvidence
    until: np.ndarray  # float16 [s]
    is_sure: np.ndarray  # bool, surely moving
    is_moving: np.ndarray  # bool, with what moves along

    @classmethod
    def none(cls, n: int, places: tuple[int, int]) -> "MovingSightings":
        """Begin with nothing seen in any of n views."""
        half, flag = ((n, *places), np.float16), ((n, *places), np.bool_)
        return cls(*(np.zeros(*kind) for kind in (half, half, half, flag, flag)))

    def note(self, frame: int, evidence: PlaceEvidence, is_sure: np.ndarray, is_moving: np.ndarray) -> None:
        """Keep what is known of a view."""
        self.depth[frame], self.since[frame], self.until[frame] = evidence.depth, evidence.since, evidence.until
        self.is_sure[frame], self.is_moving[frame] = is_sure, is_moving

    def z(self, frame: int) -> np.ndarray:
        """Return the depth (v, u) float32 [m] of a view."""
        return self.depth[frame].astype(np.float32)


def follow(views: Views, sightings: MovingSightings, *, most: float) -> np.ndarray:
    """Find what moves in every view, (F, v, u) bool, also while it stands; most : [s] that it may have stood there."""
    n = len(views.stamp)
    found = sightings.is_moving.copy()
    for sign, order in ((-1.0, range(n)), (1.0, range(n - 1, -1, -1))):
        before, left = -1, np.empty(0)
        for frame in order:
            left = _left_at(views, sightings, (before, frame), left, sign, most)
            found[frame] |= np.isfinite(left)
            before = frame
    for frame in range(n):
        for _ in range(FILL_ROUNDS):
            found[frame] = kernels.fill(found[frame], sightings.z(frame), JUMP, FILLED)
    return found


def _left_at(
    views: Views, sightings: MovingSightings, frames: tuple[int, int], left_before: np.ndarray, sign: float, most: float
) -> np.ndarray:
    """Find when (v, u) float64 [s] what moves in a view left the place that it is seen in, NaN where nothing moves.

    frames : the view that was looked at before, -1 = none, and this one; left_before : of the former
    sign : of time: 1 looks ahead to where it went, from the last view to the first; -1 back to where it came from
    """
    before, frame = frames
    now, z, is_moving = sign * views.stamp[frame], sightings.z(frame), sightings.is_moving[frame]
    again = now + (sightings.until[frame] if sign > 0 else -sightings.since[frame]).astype(np.float64)
    left = np.where(is_moving, _latest_around(again, sightings.is_sure[frame]), np.nan)
    if before < 0 or not np.isfinite(left_before).any():
        return left
    depth_views.follow(views, (sightings.z(before), z), frames, (left_before, left))
    left[~is_moving & ((again > left + GONE) | (left - now > most))] = np.nan
    is_seen = np.isfinite(left)
    is_thin = (n_around(is_seen) < THICK) | ~kernels.groups(is_seen, z, JUMP, LEAST)
    left[~is_moving & is_thin] = np.nan
    return left


def _latest_around(when: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
    """Return the latest time [s] near each place (v, u) at which what surely moves is seen in its place."""
    side = 2 * GROWTH_MOST + 1
    return cv2.dilate(np.where(is_sure, when, -np.inf), np.ones((side, side), np.uint8))


def n_around(places: np.ndarray) -> np.ndarray:
    """Count (v, u) how many of a place and its eight neighbours are among `places` (v, u) bool."""
    return cv2.boxFilter(places.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_REPLICATE)
