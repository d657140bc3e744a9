"""What the recording itself says about its camera: numbers that all observations share, found together with the map.

By `estimation/shared_parameters.py`, from what `measurement_derivatives.py` says of each.

A factor on all depth readings stays as it is believed to be: a world, a path and depths that are all stretched alike show the same
pictures. An offset of inverse depth, as of a sensor whose disparities are off by a constant, bends the world and is found.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamcli import mapped_memory
from slamcli.calibration import rolling_shutter
from slamcli.calibration.measurement_derivatives import TIMES, Predictions, current_value, derivative
from slamcli.config.options import OptimizeConfig, SensorConfig
from slamcli.estimation import shared_parameters
from slamcli.estimation.bundle_problem import INV_SIGMA_Z, Problem
from slamcli.estimation.robust_loss import LEAST_SQUARES
from slamcli.estimation.shared_parameters import Shared
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Timing
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap

SIGNIFICANT = 3.0  # standard deviations
MOST_KEY_FRAMES = 80  # whose landmarks are asked what they would have changed
POSE, POINT = 6, 3  # unknowns of a key frame and of a landmark
ROWS_AT_ONCE = 1 << 18  # features recalibrated together: the intermediate results of a long recording would fill the memory


@dataclass(frozen=True)
class Sensing:
    """Where and when the camera measures, and how sure that is."""

    camera: Camera
    timing: Timing
    sigma: dict[str, float]  # of the numbers that were found, by name; before looking, how far they are believed to be off


def unknowns(camera: Camera, option: OptimizeConfig) -> dict[str, float]:
    """Return the numbers to be found, fields of Timing or Camera, and how far each is believed to be from what the recording says."""
    prior = {}
    if option.readout:
        prior["readout"] = option.timing_prior
    if option.readout and option.move_depth:
        prior["depth_readout"] = option.timing_prior
    if option.move_depth and option.depth_delay:
        prior["depth_delay"] = option.timing_prior
    if option.intrinsics:
        prior |= {"fx": option.focal_prior * camera.fx, "fy": option.focal_prior * camera.fy}
        prior |= {"cx": option.centre_prior, "cy": option.centre_prior}
    if option.depth_scale:
        prior |= {"depth_scale": option.depth_scale_prior * camera.depth_scale, "inverse_depth_offset": option.inverse_depth_prior}
    return prior


def correct(features: Features, given: Camera, sensing: Sensing) -> Features:
    """Return features, measured under the calibration `given`, as they are under what is known of the camera now."""
    return rolling_shutter.rectify(recalibrate(features, given, sensing.camera), sensing.timing, sensing.camera)


def recalibrate(features: Features, given: Camera, camera: Camera) -> Features:
    """Return features, measured under the calibration `given`, as they are under another one of the same camera."""
    if camera == given:
        return features
    xy, depth, slope = (mapped_memory.empty(column.shape, column.dtype) for column in (features.xy, features.depth, features.slope))
    growth = np.float32(camera.depth_scale / given.depth_scale)
    for start in range(0, len(xy), ROWS_AT_ONCE):
        part = slice(start, start + ROWS_AT_ONCE)
        xy[part] = camera.undistort(given.distort(features.xy[part]))
        depth[part] = camera.reread(features.depth[part], given)
        slope[part] = features.slope[part] * growth
    return replace(features, xy=xy, depth=depth, slope=slope)


def estimate_sensing(
    sparse_map: SparseMap, given: Camera, now: Sensing, sensor: SensorConfig, *, prior: dict[str, float]
) -> Sensing | None:
    """Find the unknowns at an adjusted map whose features were corrected by `now`.

    given : the recording's calibration; prior : as `unknowns` gives it, standard deviations of the timing around 0, of the rest around `given`
    Returns better numbers, with the same motion, those as before that do not differ significantly; None where the map is not determined.
    """
    part = map_adjustment.gather(sparse_map, np.arange(len(sparse_map.kf), dtype=np.int32), sensor)
    asked = _ask(sparse_map, part, now, prior)
    if asked is None:
        return None
    problem, columns, pivot = asked
    names = list(prior)
    value, centre = (
        np.array([current_value(name, camera, when, pivot=pivot) for name in names])
        for camera, when in ((now.camera, now.timing), (given, None))
    )
    found = shared_parameters.estimate(problem, columns, prior=centre - value, prior_sigma=np.array(list(prior.values())))
    if found is None:
        return None
    value = value + found.value
    # What cannot be told from what was believed stays so: the noise of its estimate would go into all measurements for nothing.
    value = np.where(np.abs(value - centre) > SIGNIFICANT * found.sigma, value, centre)
    better = dict(zip(names, value.tolist(), strict=True))
    if "depth_scale" in better:
        better["depth_scale"] *= 1.0 - better["inverse_depth_offset"] * pivot
    when = {name: np.array(better.pop(name)) for name in TIMES if name in better}
    return Sensing(replace(now.camera, **better), replace(now.timing, **when), dict(zip(names, found.sigma.tolist(), strict=True)))


@dataclass(frozen=True)
class Deviations:
    """By how much a map would have numbers changed."""

    found: Shared  # in the order of the prior
    unit_sigma: float  # of the residuals, in what is believed of them: `found.sigma` is to be multiplied by it


def deviations(sparse_map: SparseMap, now: Sensing, sensor: SensorConfig, *, prior: dict[str, float]) -> Deviations | None:
    """Find by how much an adjusted map would have numbers changed; None where the map is not determined.

    prior : standard deviations: of fields of Camera, and of what `measurement_derivatives` knows besides, around what is known now; of fields
        of Timing around 0, as a time that the map was given may have taken the place of what is asked for
    Only landmarks count, and in a long recording those of a stretch of MOST_KEY_FRAMES: edges were measured with the numbers in question.
    """
    n = len(sparse_map.kf)
    first = max(0, (n - MOST_KEY_FRAMES) // 2)
    part = map_adjustment.gather(sparse_map, np.arange(n, dtype=np.int32), sensor)
    part = map_adjustment.landmarks_alone(part, first, first + MOST_KEY_FRAMES)
    asked = _ask(sparse_map, part, now, prior)
    if asked is None:
        return None
    problem, columns, _ = asked
    centre = np.array([-float(getattr(now.timing, name)) if name in TIMES else 0.0 for name in prior])
    found = shared_parameters.estimate(problem, columns, prior=centre, prior_sigma=np.array(list(prior.values())))
    return None if found is None else Deviations(found, _unit_sigma(problem, part.seen.lm))


def _unit_sigma(problem: Problem, lm: np.ndarray) -> float:
    """Estimate the standard deviation of unit weight: of all residuals of inliers, in the standard deviations that they were given.

    lm : (O,) landmark of each observation, in the order given
    """
    chi2 = problem.chi2(problem.start)
    chi2, is_used = problem.in_given_order(chi2), problem.in_given_order(problem.is_inlier(chi2))
    has_depth = problem.in_given_order(problem.measured[:, INV_SIGMA_Z] > 0.0)
    n_residuals = 2 * int(is_used.sum()) + int((is_used & has_depth).sum())
    n_unknowns = problem.hold.size * POSE + len(np.unique(lm[is_used])) * POINT
    return float(np.sqrt(chi2[is_used].sum() / max(n_residuals - n_unknowns, 1)))


def _ask(
    sparse_map: SparseMap, part: map_adjustment.MapPart, now: Sensing, prior: dict[str, float]
) -> tuple[Problem, np.ndarray, float] | None:
    """Make the problem whose optimum the map is, what each unknown does to its measurements (O, 3, G), and the depth that offsets turn about."""
    if len(part.row) == 0 or not prior:
        return None
    start = part.start(sparse_map)
    problem = Problem(start, part.seen, now.camera, is_fixed=part.is_fixed, edges=part.edges, loss=LEAST_SQUARES)
    predicted = problem.in_given_order(problem.predict(problem.start))
    seen = Predictions(sparse_map.features, part.row, predicted, now.camera, now.timing)
    columns = [derivative(name, seen, sigma=sigma) for name, sigma in prior.items()]
    return problem, np.stack(columns, axis=2), seen.pivot
