"""By how much measurements grow per unit of each number of the calibration that may be unknown.

The derivatives are taken where the map says that the measurements should be. Readings themselves would not do for what stretches them: it
stretches their errors too, and the least errors are those of the smallest camera.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamcli.calibration import rolling_shutter
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Timing

TIMES = "readout", "depth_readout", "depth_delay"  # fields of Timing
DEPTH = "depth_scale", "inverse_depth_offset"  # fields of Camera that change its readings; its other ones change its pixels
# Of no record: the share of both focal lengths, and [px] by which depth lies off colour.
FOCAL, SHIFTS = "focal", ("shift_x", "shift_y")
STEP = 1e-3  # of its prior sigma, by which an unknown of the lens is moved to see what that does


@dataclass(frozen=True)
class Predictions:
    """Where the map says that its landmarks should be measured, by which features they were, and what is known of the camera."""

    features: Features
    rows: np.ndarray  # (O,) of the features
    predicted: np.ndarray  # (O, 3) u, v [px], depth [m]
    camera: Camera
    timing: Timing

    @property
    def pivot(self) -> float:
        """Return the depth [m] of readings that the offset of inverse depth is to leave as they are.

        What an offset bends is to turn about it, so that it changes no size that the depth scale answers for.
        """
        return float(np.median(self.predicted[:, 2]))


def current_value(name: str, camera: Camera, when: Timing | None, *, pivot: float) -> float:
    """Return the current value of a calibration parameter, or its prior when it has not been estimated (`when` is None).

    The depth scale is that of readings at depth `pivot` [m].
    """
    if name == "depth_scale":
        return camera.depth_scale / (1.0 - camera.inverse_depth_offset * pivot)
    if hasattr(camera, name):
        return float(getattr(camera, name))
    return 0.0 if when is None else float(getattr(when, name))


def derivative(name: str, seen: Predictions, *, sigma: float) -> np.ndarray:
    """Return by how much u, v [px] and depth [m] of the measurements grow per unit of an unknown, (O, 3).

    sigma : how far the unknown is believed to be off
    """
    if name in TIMES:
        return _of_time(name, seen)
    if name in SHIFTS:
        return _of_shift(SHIFTS.index(name), seen)
    if name in DEPTH:
        return _of_depth(name, seen)
    if name == FOCAL:
        both = (("fx", seen.camera.fx), ("fy", seen.camera.fy))
        return sum((value * _of_lens(field, seen, sigma=sigma * value) for field, value in both), np.zeros(1))
    return _of_lens(name, seen, sigma=sigma)


def _of_time(name: str, seen: Predictions) -> np.ndarray:
    """Move with the camera: by a row's share of the readout of colour or depth, or by a delay of depth."""
    moving = rolling_shutter.flow(seen.features, seen.timing.twist, seen.camera, seen.rows)
    column = np.zeros_like(seen.predicted)
    if name == "readout":
        column[:, :2] = -moving.px_per_s * moving.share[:, None]
        column[:, 2] = -moving.slant_per_s * moving.share
    else:
        column[:, 2] = -moving.reading_per_s * (moving.share if name == "depth_readout" else 1.0)
    return column


def _of_shift(axis: int, seen: Predictions) -> np.ndarray:
    """Read the depth of a slanted surface so far from where it belongs."""
    column = np.zeros_like(seen.predicted)
    column[:, 2] = -(seen.predicted[:, 2] ** 2) * np.asarray(seen.features.slope[seen.rows, axis], dtype=np.float64)
    return column


def _of_depth(name: str, seen: Predictions) -> np.ndarray:
    """Stretch the readings, or shift their inverse with those at the pivot staying."""
    z, offset, pivot = seen.predicted[:, 2], seen.camera.inverse_depth_offset, seen.pivot
    read = 1.0 / z - offset  # [1/m] inverse of the readings, before the offset
    per_inverse = -z * z
    column = np.zeros_like(seen.predicted)
    if name == "depth_scale":
        column[:, 2] = per_inverse * read / current_value(name, seen.camera, None, pivot=pivot)
    else:
        column[:, 2] = per_inverse * (1.0 - read * pivot / (1.0 - offset * pivot))
    return column


def _of_lens(name: str, seen: Predictions, *, sigma: float) -> np.ndarray:
    """Move where the ray of a raw pixel points, told in pixels of the camera as it is known now, in which predictions are told too."""
    raw, step = seen.camera.distort(seen.predicted[:, :2]), STEP * sigma
    ahead, behind = (replace(seen.camera, **{name: getattr(seen.camera, name) + d}) for d in (step, -step))
    focal = np.array([seen.camera.fx, seen.camera.fy])
    column = np.zeros_like(seen.predicted)
    column[:, :2] = (ahead.normalize(raw) - behind.normalize(raw)) * focal / (2.0 * step)
    return column
