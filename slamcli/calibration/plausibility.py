"""Does the map bear out the calibration? What the recording says of numbers that were given as certain.

Two looks that do not depend on one another. A map at its optimum says by how much each number of the camera would have to change to
make its residuals least, and how sure that is (`estimation/shared_parameters.py`); a sound one says zero for all of them. Times that the map
was given are asked anew with them: a principal point that is wrong looks like rows read one after the other. And points seen
from two places keep their distances from one another: under a wrong focal length the same points, measured in depth and pixels in two
parts of the image, are no rigid body. That needs no pose, so it also holds where a map is ruined.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import f8

from slamcli.calibration import self_calibration
from slamcli.calibration.measurement_derivatives import TIMES
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import SensorConfig
from slamcli.depth import noise_model
from slamcli.geometry import depth_noise, elementary
from slamcli.geometry.algebra import nearest_rotation
from slamcli.geometry.camera import Camera
from slamcli.jit.kernel import kernel
from slamcli.sparse_map.sparse_map import SparseMap

# Standard deviations of what is looked for: wide, as whatever the map says is to be heard. Shares of the focal length and of the picture's
# width; k1 as it is; [1/m]. Of times around 0 [s], as of cameras that read their rows one after the other.
PRIOR_FOCAL, PRIOR_CENTRE, PRIOR_LENS, PRIOR_SHIFT, PRIOR_DISPARITY, PRIOR_TIME = 0.3, 0.1, 0.3, 0.05, 0.05, 0.02
SHARED = 25  # landmarks with depth that two key frames share, to be compared
NEXT = 5  # later key frames that each is compared with
MOST_PAIRS = 60  # of key frames, evenly spread
FACTORS = np.geomspace(1 / 2.8, 2.8, 37)  # on the focal length, tried on all pairs
ROUNDS = 3  # in which false matches lose their weight
FARTHEST = 6.0  # [m] of the points compared: beyond, depth says little


@dataclass(frozen=True)
class Deviation:
    """By how much the map would have a number changed."""

    value: float
    sigma: float  # as the map's own residuals say: they may be smaller or larger than the noise model has them

    def beyond(self, tolerated: float) -> float:
        """Return by how many standard deviations the value exceeds a size that is tolerated; at most 0 where it does not."""
        return (abs(self.value) - tolerated) / self.sigma


@dataclass(frozen=True)
class SeenTwice:
    """Points as one view sees them, row by row those of another view."""

    xy: np.ndarray  # (N, 2) px, undistorted
    depth: np.ndarray  # (N,) m, NaN = none


@dataclass(frozen=True)
class Rigidity:
    """How rigid the points are that two key frames see, under other focal lengths."""

    factor: float  # on the focal length, under which they are most rigid
    gain: float  # times by which they are more rigid then than under the one given
    pairs: int  # of key frames that were compared


def deviations(sparse_map: SparseMap, now: Sensing, sensor: SensorConfig) -> dict[str, Deviation]:
    """Find by how much an adjusted map would have the camera changed; nothing where it is not determined.

    Returns "focal", a share of fx and fy alike; "cx", "cy", "shift_x", "shift_y" (of depth on colour), shares of the picture's width; "k1".
    """
    width = float(now.camera.width)
    unit = {"focal": 1.0, "cx": width, "cy": width, "k1": 1.0, "shift_x": width, "shift_y": width}
    share = {"focal": PRIOR_FOCAL, "cx": PRIOR_CENTRE, "cy": PRIOR_CENTRE, "k1": PRIOR_LENS, "shift_x": PRIOR_SHIFT, "shift_y": PRIOR_SHIFT}
    # What an error of disparity bends is not to be taken for a lens.
    prior = {name: share[name] * unit[name] for name in share} | {"inverse_depth_offset": PRIOR_DISPARITY}
    prior |= {name: PRIOR_TIME for name in TIMES if name in now.sigma}
    asked = self_calibration.deviations(sparse_map, now, sensor, prior=prior)
    if asked is None:
        return {}
    shares = zip(prior, asked.found.value, asked.found.sigma, strict=True)
    return {
        name: Deviation(float(value) / unit[name], float(sigma) * asked.unit_sigma / unit[name])
        for name, value, sigma in shares
        if name in unit
    }


def rigidity(sparse_map: SparseMap, camera: Camera, sensor: SensorConfig) -> Rigidity | None:
    """Find the focal length under which points seen by two key frames are most rigid; None where no two see enough together."""
    return most_rigid((_shared(sparse_map, i, j) for i, j in _pairs(sparse_map)), camera, sensor)


def most_rigid(views: Iterable[tuple[SeenTwice, SeenTwice]], camera: Camera, sensor: SensorConfig) -> Rigidity | None:
    """Find the focal length under which points are most rigid, of which each pair of views shows some, row by row.

    None where no pair shows enough points with depth. Some rows may be false matches.
    """
    costs = [cost for pair in views if (cost := _misfit(*pair, camera, sensor)) is not None]
    if not costs:
        return None
    total = np.mean(costs, axis=0)
    best = int(np.argmin(total))
    given = float(np.interp(0.0, elementary.log(FACTORS), total))
    return Rigidity(_summit(total, best), given / max(float(total[best]), 1e-9), len(costs))


def _pairs(sparse_map: SparseMap) -> list[tuple[int, int]]:
    """List pairs of key frames that share enough landmarks."""
    found: list[tuple[int, int]] = []
    for i in range(len(sparse_map.kf)):
        shared = sparse_map.votes(sparse_map.landmarks_of(i))
        found += [(i, int(j)) for j in i + 1 + np.flatnonzero(shared[i + 1 : i + 1 + NEXT] >= SHARED)]
    return [found[k] for k in sorted({int(k) for k in np.linspace(0, len(found) - 1, min(len(found), MOST_PAIRS))})] if found else []


def _shared(sparse_map: SparseMap, i: int, j: int) -> tuple[SeenTwice, SeenTwice]:
    """Return how two key frames see the landmarks that they share."""
    first, second = (sparse_map.rows_of(kf) for kf in (i, j))
    # A landmark is seen once by a key frame; features without one are told apart by their numbers.
    of_first, of_second = (np.where(ids >= 0, ids, -k) for ids, k in ((sparse_map.lm_of_row[first], 1), (sparse_map.lm_of_row[second], 2)))
    _, at_first, at_second = np.intersect1d(of_first, of_second, return_indices=True)
    features, rows = sparse_map.features, (first.start + at_first, second.start + at_second)
    a, b = (SeenTwice(np.asarray(features.xy[row], dtype=np.float64), np.asarray(features.depth[row], dtype=np.float64)) for row in rows)
    return a, b


def _misfit(a: SeenTwice, b: SeenTwice, camera: Camera, sensor: SensorConfig) -> np.ndarray | None:
    """Return how far points seen twice are from a rigid body, median in standard deviations, for each of FACTORS; None of too few."""
    with np.errstate(invalid="ignore"):
        is_near = (a.depth < FARTHEST) & (b.depth < FARTHEST)
    if is_near.sum() < SHARED:
        return None
    x = [camera.backproject(seen.xy[is_near], seen.depth[is_near]) for seen in (a, b)]
    noise = noise_model.depth_noise(sensor)
    sigma = np.linalg.norm([depth_noise.sigmas(p[:, 2], noise) for p in x], axis=0)
    misfit = np.zeros((len(FACTORS), int(is_near.sum())))
    for _ in range(ROUNDS):  # false matches lose their weight
        _strain(x[0], x[1], sigma, misfit)
    return np.median(misfit, axis=1)


def _strain(a: np.ndarray, b: np.ndarray, sigma: np.ndarray, misfit: np.ndarray) -> None:
    """Write the distances that the rigid motion from points a (N, 3) to b leaves under each of FACTORS, (S, N) in standard deviations.

    misfit holds those of the round before, which say what weight a point has.
    W. Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst. A32, 1976, doi:10.1107/S0567739476001873
    """
    middle, moment = np.empty((len(FACTORS), 2, 3)), np.empty((len(FACTORS), 3, 3))
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    _moments(a, b, sigma, FACTORS, misfit, middle, moment)
    _distances(a, b, sigma, FACTORS, middle, nearest_rotation(moment), misfit)


@kernel(error_model="numpy")
def _moments(
    a: f8[:, ::1], b: f8[:, ::1], sigma: f8[::1], factor: f8[::1], misfit: f8[:, ::1], middle: f8[:, :, ::1], moment: f8[:, :, ::1]
) -> None:
    """Write the weighted means of a and b (S, 2, 3) and their mixed second moments about them (S, 3, 3), x and y shrunk by each factor."""
    for s in range(len(factor)):
        shrink = (1.0 / factor[s], 1.0 / factor[s], 1.0)
        total = 0.0
        middle[s], moment[s] = 0.0, 0.0
        for n in range(len(a)):
            w = 1.0 / ((1.0 + misfit[s, n] * misfit[s, n]) * sigma[n] * sigma[n])
            total += w
            for i in range(3):
                middle[s, 0, i] += w * a[n, i]
                middle[s, 1, i] += w * b[n, i]
                for j in range(3):
                    moment[s, i, j] += w * a[n, i] * b[n, j]
        for i in range(3):
            for j in range(3):
                mixed = moment[s, i, j] - middle[s, 0, i] * middle[s, 1, j] / total
                moment[s, i, j] = mixed / total * shrink[i] * shrink[j]
        for i in range(3):
            middle[s, 0, i] *= shrink[i] / total
            middle[s, 1, i] *= shrink[i] / total


@kernel(error_model="numpy")
def _distances(
    a: f8[:, ::1], b: f8[:, ::1], sigma: f8[::1], factor: f8[::1], middle: f8[:, :, ::1], R: f8[:, :, ::1], misfit: f8[:, ::1]
) -> None:
    """Write the lengths of b - a R (S, N) about the means, in sigma."""
    for s in range(len(factor)):
        shrink = 1.0 / factor[s]
        for n in range(len(a)):
            a0, a1, a2 = shrink * a[n, 0] - middle[s, 0, 0], shrink * a[n, 1] - middle[s, 0, 1], a[n, 2] - middle[s, 0, 2]
            d0 = shrink * b[n, 0] - middle[s, 1, 0] - (a0 * R[s, 0, 0] + a1 * R[s, 1, 0] + a2 * R[s, 2, 0])
            d1 = shrink * b[n, 1] - middle[s, 1, 1] - (a0 * R[s, 0, 1] + a1 * R[s, 1, 1] + a2 * R[s, 2, 1])
            d2 = b[n, 2] - middle[s, 1, 2] - (a0 * R[s, 0, 2] + a1 * R[s, 1, 2] + a2 * R[s, 2, 2])
            misfit[s, n] = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2) / sigma[n]


def _summit(total: np.ndarray, best: int) -> float:
    """Return the factor between FACTORS where the cost is least, by the parabola through three of them."""
    if not 0 < best < len(total) - 1:
        return float(FACTORS[best])
    before, here, after = total[best - 1 : best + 2]
    bend = before - 2.0 * here + after
    step = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(FACTORS[best] * (FACTORS[1] / FACTORS[0]) ** step)
