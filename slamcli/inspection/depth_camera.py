"""Find the depth camera of a recording whose depth was never registered to colour: its focal length, and where it sits.

Where depth jumps an object ends, and there the picture has an edge. Under the right focal length, turn and offset the depth edges, each moved
by its own depth, lie on the picture's; near and far ones tell the offset from the turn, and the corners of the image the turn from the
place of the principal point. From afar the numbers with the most contrast are climbed to; from nearby each edge looks for the picture's,
and least squares over all give the numbers and how sure they are. A map made with them knows better still (`calibration/registration.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import minimize

from slamcli.datasets import Dataset
from slamcli.estimation.shared_parameters import SharedEvidence
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_registration import Registration
from slamcli.inspection import registration
from slamcli.inspection.registration import ColourEdges, DepthEdges

# All numbers of a depth camera: logarithm of the focal length, principal point [px], rotation vector [rad] and translation [m] of T_cd.
FOCAL, CENTRE, TURN, OFFSET = 0, slice(1, 3), slice(3, 6), slice(6, 9)
# Those that are climbed to: a principal point looks like a turn from afar, an offset ahead like nothing.
CLIMBED = np.array([0, 3, 4, 5, 6, 7])

BLUR = (8.0, 4.0, 2.0)  # [px] of the pictures' steepness, from round to round: what is far off is found first
LAGS = (-0.02, -0.01, 0.0, 0.01, 0.02, 0.03)  # [s] by which depth stamps may be late
START_LAG = 0.01  # [s]
LAG_PRICE = 1.0  # [1/s] share of the contrast that a lag must bring
STARTS = (0.75, 0.9, 1.12, 1.37)  # magnifications tried where none is known
# What moves edges by about as far, a pixel or so at a picture of 640: share of the focal length, turns [rad], offsets [m].
STEP = np.array([4e-3, 2e-3, 2e-3, 4e-3, 3e-3, 3e-3])
EVALUATIONS = 400  # of the score at most in each round
BELIEVED = np.array([0.05, 0.05, 0.05, 0.05, 0.05])  # [rad, m] turn and offset are about this at most
CAUTION = 0.004  # of the mean steepness: what a turn or an offset as large as BELIEVED must bring

ALIGNMENTS = 6  # times that edges look for the picture's, from ever better numbers
REACH, TICK = 4.0, 0.5  # [px] to either side of an edge where it looks, and how finely
LEAST_STEEPNESS = 100.0  # of 255, of an edge of the picture
WEIGHINGS = 10  # rounds in which edges that lie on none of the same object lose their weight
LEAST_SCATTER = 0.3  # [px]
DIFFERENCE = np.array([1e-4, 0.1, 0.1, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])  # by which numbers are moved to see what that does
# How far numbers are believed to be from the focal length that was climbed to, the middle of the image and colour's place. The principal
# point's is a share of the image's width. An offset ahead stretches the map and nothing tells it: cameras of one housing have none.
CENTRE_SHARE = 0.01
BELIEVED_FOCAL, BELIEVED_TURN, BELIEVED_ASIDE, BELIEVED_AHEAD = 0.5, 0.05, 0.05, 1e-3  # [share, rad, m, m]
BELIEVED_GROWTH = 1.0  # [px] by which a camera shows objects too large in depth
ALIKE = 300.0  # edges that err together: along one outline, in picture after picture,
ALIKE_IN_MAP = 4.0  # and residuals of a map: what is read wrong of a surface is so from all sides
MOST_CONTRADICTION = 2.0  # chi^2 by degree of freedom between edges and map; rooms have 0.3 to 1.5, fr1_xyz 2.7 and 3.8
# The evidence that is beyond doubt.
LEAST_CONTRAST = 2.0  # steepness under the edges over the mean; wrong ones reach 1.5
BETTER = 1.4  # times the contrast with depth as it is
LEAST_DIFFERENCE = 0.04  # of its focal length from colour's, as a share: depth that was only moved is no other camera's
LARGEST_SIGMA = 0.012  # of the focal length, as a share of it
LARGEST_TURN, LARGEST_OFFSET = 0.06, 0.08  # [rad, m] of a depth camera in one housing with a colour camera


@dataclass(frozen=True)
class DepthCamera:
    """A depth camera as its edges on the pictures tell it, for depth images of the pictures' size."""

    numbers: np.ndarray  # (9,) as above
    information: np.ndarray  # (9, 9) inverse of their covariance
    contrast: float  # of the pictures' steepness under the depth edges
    contrast_before: float  # with depth as it is
    focal_of_colour: float  # [px]

    @property
    def focal(self) -> float:
        """Return the focal length [px]."""
        return float(np.exp(self.numbers[FOCAL]))

    @property
    def turn(self) -> np.ndarray:
        """Return the rotation vector of T_cd (3,) [rad]."""
        return self.numbers[TURN]

    @property
    def offset(self) -> np.ndarray:
        """Return the translation of T_cd (3,) [m]."""
        return self.numbers[OFFSET]

    @property
    def sigma(self) -> np.ndarray:
        """Return the standard deviations of the numbers (9,)."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))

    @property
    def is_sure(self) -> bool:
        """Say whether the evidence is beyond doubt."""
        is_possible = np.linalg.norm(self.turn) < LARGEST_TURN and np.linalg.norm(self.offset) < LARGEST_OFFSET
        is_clear = self.contrast >= LEAST_CONTRAST and self.contrast >= BETTER * self.contrast_before
        is_another = abs(self.focal / self.focal_of_colour - 1.0) >= LEAST_DIFFERENCE
        return bool(is_possible and is_clear and is_another and self.sigma[FOCAL] <= LARGEST_SIGMA)

    @property
    def option(self) -> str:
        """Write it as `recording.depth_camera` has it."""
        numbers = (self.focal, self.focal, *self.numbers[CENTRE], *self.offset, *self.turn)
        return " ".join(f"{number:.6g}" for number in numbers)

    @property
    def told(self) -> str:
        """Say in a sentence what was found."""
        turned, aside, sigma = np.degrees(np.linalg.norm(self.turn)), 1000 * np.linalg.norm(self.offset), self.sigma
        return (
            f"depth is of another camera than colour and is registered on reading, as its edges and the map tell: focal length "
            f"{self.focal:.1f} +- {self.focal * sigma[FOCAL]:.1f} px, {aside:.0f} +- {1000 * np.linalg.norm(sigma[OFFSET]):.0f} mm aside, "
            f"turned by {turned:.1f} degrees"
        )

    def registration(self, colour: Camera) -> Registration:
        """Return how depth of this camera comes to colour's."""
        (cx, cy), size = self.numbers[CENTRE].tolist(), (colour.width, colour.height)
        camera = Camera(*size, self.focal, self.focal, cx, cy, depth_scale=colour.depth_scale)
        return Registration(camera, colour, transform(self.turn, self.offset))

    def told_by(self, map_: SharedEvidence) -> "DepthCamera":
        """Return it with what a map that was made with it says of the same numbers, or as it is where both contradict one another.

        A depth camera that is bent by itself makes a map that calls for another turn and principal point than the edges do.
        """
        expected = map_.information + map_.information @ np.linalg.solve(self.information, map_.information)  # covariance of the pull
        if map_.pull @ np.linalg.lstsq(expected, map_.pull)[0] > MOST_CONTRADICTION * len(map_.pull):
            return self
        both = self.information + map_.information / ALIKE_IN_MAP
        return replace(self, numbers=self.numbers + np.linalg.solve(both, map_.pull / ALIKE_IN_MAP), information=both)


def find(dataset: Dataset, *, workers: int = 2) -> DepthCamera | None:
    """Find the depth camera of unregistered depth; None where there are too few edges."""
    colours, edges = registration.collect(dataset, workers, registration.BLOCKS)
    if sum(len(e.xy) for e in edges) < registration.LEAST_POINTS:
        return None
    overlay, as_it_is = _Overlay(dataset, colours, edges, START_LAG), _like_colour(dataset.camera)
    magnification = registration.magnification_of(dataset, colours, edges)
    factors = (magnification,) if magnification is not None else STARTS
    starts = [as_it_is - np.log(factor) * np.eye(9)[FOCAL] for factor in factors]
    rough = max((_climb(overlay, start, BLUR[:2]) for start in starts), key=overlay.contrast)
    tried = [(lag, _climb(overlay := _Overlay(dataset, colours, edges, lag), rough, BLUR[2:]), overlay) for lag in LAGS]
    # In an even motion a lag passes for an offset: without more contrast there is none.
    _, near, overlay = max(tried, key=lambda one: (1.0 - LAG_PRICE * abs(one[0])) * one[2].contrast(one[1]))
    overlay.blur(0.0)
    found, information = _align(overlay, near, dataset.camera)
    return DepthCamera(found, information, overlay.contrast(found), overlay.contrast_as_it_is, float(dataset.camera.fx))


def _like_colour(camera: Camera) -> np.ndarray:
    """Return the numbers (9,) of a depth camera that is like colour's, at its place."""
    numbers = np.zeros(9)
    numbers[FOCAL], numbers[CENTRE] = np.log(camera.fx), (0.5 * (camera.width - 1), 0.5 * (camera.height - 1))
    return numbers


class _Overlay:
    """Depth edges laid over the pictures nearest in time to them. `N` edges."""

    def __init__(self, dataset: Dataset, colours: ColourEdges, edges: Sequence[DepthEdges], lag: float) -> None:
        self._camera, self._colours, self._steepness, self._mean = dataset.camera, colours, colours.steepness, 1.0
        near = [(e, int(np.abs(colours.stamp - (e.stamp - lag)).argmin())) for e in edges]
        near = [(e, k) for e, k in near if abs(colours.stamp[k] - (e.stamp - lag)) <= registration.LONGEST_STEP]
        self._picture = np.concatenate([np.full(len(e.xy), k) for e, k in near])
        seconds = np.concatenate([np.full(len(e.xy), colours.stamp[k] - (e.stamp - lag)) for e, k in near])
        self._seconds, self._xy = seconds[:, None], np.concatenate([e.xy for e, _ in near]).astype(np.float64)
        self._z = np.concatenate([e.depth for e, _ in near]).astype(np.float64)[:, None]
        self._along = np.concatenate([e.is_along_y for e, _ in near]).astype(np.int64)
        self.outward = np.concatenate([e.outward for e, _ in near]).astype(np.float64)
        self._velocity = np.stack(colours.velocity)

    def blur(self, sigma: float) -> None:
        """Smooth the pictures' steepness by so many pixels."""
        sharp = self._colours.steepness
        self._steepness = sharp if sigma == 0.0 else np.stack([[cv2.GaussianBlur(one, (0, 0), sigma) for one in way] for way in sharp])
        self._mean = float(self._steepness.mean())

    def contrast(self, numbers: np.ndarray) -> float:
        """Return the mean steepness under the edges over that of the pictures; what falls outside counts as the mean."""
        return self._contrast(self.moved(numbers))

    @property
    def contrast_as_it_is(self) -> float:
        """Return that contrast with depth where it lies."""
        return self._contrast(self._carried(self._xy))

    def _contrast(self, xy: np.ndarray) -> float:
        return float(np.where(self.is_inside(xy, 1.0), self._steep(xy), self._mean).mean()) / self._mean

    def profile(self, xy: np.ndarray, ticks: np.ndarray) -> np.ndarray:
        """Return the pictures' steepness (T, N) so many pixels from the places xy (N, 2), in the direction of each edge's jump."""
        return np.stack([self._steep(xy + tick * self.across) for tick in ticks])

    @property
    def across(self) -> np.ndarray:
        """Return the direction of each edge's jump (N, 2)."""
        return np.eye(2)[self._along]

    def is_inside(self, xy: np.ndarray, margin: float) -> np.ndarray:
        """Say which places (N, 2) lie at least so many pixels inside their picture."""
        height, width = self._steepness.shape[2:]
        return np.asarray((xy >= margin).all(axis=1) & (xy[:, 0] < width - 1.0 - margin) & (xy[:, 1] < height - 1.0 - margin))

    def _steep(self, xy: np.ndarray) -> np.ndarray:
        """Return the steepness (N,) at places (N, 2), interpolated; outside, any."""
        height, width = self._steepness.shape[2:]
        u, v = np.clip(np.nan_to_num(xy[:, 0]), 0.0, width - 2.0), np.clip(np.nan_to_num(xy[:, 1]), 0.0, height - 2.0)
        column, row = u.astype(np.int64), v.astype(np.int64)
        a, b = u - column, v - row
        at = [self._steepness[self._along, self._picture, row + down, column + right] for down in (0, 1) for right in (0, 1)]
        return np.asarray((1 - b) * ((1 - a) * at[0] + a * at[1]) + b * ((1 - a) * at[2] + a * at[3]))

    def moved(self, numbers: np.ndarray) -> np.ndarray:
        """Return the raw pixels (N, 2) of the pictures in which the edges lie."""
        ray = np.concatenate([(self._xy - numbers[CENTRE]) / np.exp(numbers[FOCAL]), np.ones_like(self._z)], axis=1)
        x_c = se3.transform(transform(numbers[TURN], numbers[OFFSET]), ray * self._z)
        return self._carried(self._camera.distort(self._camera.project(x_c)))

    def _carried(self, xy: np.ndarray) -> np.ndarray:
        """Carry places (N, 2) with the pictures' motion from the time of their depth to that of their picture."""
        size = np.array(self._velocity.shape[2:0:-1]) - 1
        small = np.clip(np.nan_to_num(xy / self._colours.reduction), 0, size).astype(np.int64)
        return xy + self._velocity[self._picture, small[:, 1], small[:, 0]] * self._seconds


def transform(turn: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return T_cd (4, 4) of a rotation vector [rad] and a translation [m]."""
    T_cd = se3.exp(np.concatenate([np.zeros(3), turn]))
    T_cd[:3, 3] = offset
    return T_cd


def _climb(overlay: _Overlay, start: np.ndarray, blurs: Sequence[float]) -> np.ndarray:
    """Climb to the numbers with the most contrast, on pictures ever less blurred.

    J. Nelder, R. Mead, A simplex method for function minimization, 1965, doi:10.1093/comjnl/7.4.308
    """
    best = start
    for sigma in blurs:
        overlay.blur(sigma)
        origin, step = best, STEP * max(sigma, 1.0)

        def at(x: np.ndarray, origin: np.ndarray = origin, step: np.ndarray = step) -> np.ndarray:
            numbers = origin.copy()
            numbers[CLIMBED] += x * step
            return numbers

        def loss(x: np.ndarray) -> float:
            numbers = at(x)
            return CAUTION * float(((numbers[CLIMBED[1:]] / BELIEVED) ** 2).sum()) - overlay.contrast(numbers)

        simplex = np.vstack([np.zeros(6), 2.0 * np.eye(6)])
        options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": EVALUATIONS}
        best = at(minimize(loss, np.zeros(6), method="Nelder-Mead", options=options).x)
    return best


def _align(overlay: _Overlay, near: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Bring depth edges onto the edges of sharp pictures that are nearby, by least squares; returns the numbers (9,) and their information.

    Objects that depth shows too large, or too small, have their edges moved outwards: so much is an unknown of its own, or else the upper
    edges of what stands on a floor, which has no lower ones, would pass for a turn.
    """
    believed = _like_colour(camera)
    believed[FOCAL] = near[FOCAL]
    aside, centre = (BELIEVED_ASIDE, BELIEVED_ASIDE), np.full(2, CENTRE_SHARE * camera.width)
    spread = np.array([BELIEVED_FOCAL, *centre, *np.full(3, BELIEVED_TURN), *aside, BELIEVED_AHEAD, BELIEVED_GROWTH])
    prior = np.diag(1.0 / spread**2)
    x, believed, information = np.append(near, 0.0), np.append(believed, 0.0), prior
    for _ in range(ALIGNMENTS):
        J = np.stack([(overlay.moved(x[:9] + d) - overlay.moved(x[:9] - d)) / (2.0 * d.sum()) for d in np.diag(DIFFERENCE)], axis=2)
        J = np.concatenate([(J * overlay.across[:, :, None]).sum(axis=1), overlay.outward[:, None]], axis=1)
        xy = overlay.moved(x[:9]) + x[9] * overlay.outward[:, None] * overlay.across
        away, is_found = _nearest_edges(overlay, xy)
        J, away, step = J[is_found], away[is_found], np.zeros(10)
        for _ in range(WEIGHINGS):
            left = away - J @ step
            scatter = max(1.4826 * float(np.median(np.abs(left))), LEAST_SCATTER)
            weight = 1.0 / (1.0 + (left / scatter) ** 2) ** 2 / (scatter * scatter * ALIKE)
            information = (J * weight[:, None]).T @ J + prior
            step = np.linalg.solve(information, J.T @ (weight * away) + prior @ (believed - x))
        x = x + step
    return x[:9], np.linalg.inv(np.linalg.inv(information)[:9, :9])


def _nearest_edges(overlay: _Overlay, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find how far each depth edge at xy (N, 2) is from the picture's [px], to the right or downwards, and which have one (N,) bool."""
    ticks = np.arange(-REACH, REACH + 0.5 * TICK, TICK)
    steep, each = overlay.profile(xy, ticks), np.arange(len(xy))
    best = (steep * np.exp(-2.0 * (ticks[:, None] / REACH) ** 2)).argmax(axis=0).clip(1, len(ticks) - 2)
    before, here, after = (steep[best + d, each] for d in (-1, 0, 1))
    bend = before - 2.0 * here + after
    is_summit = (here > LEAST_STEEPNESS) & (here >= before) & (here >= after) & (bend < 0.0) & overlay.is_inside(xy, REACH + 1.0)
    return ticks[best] + 0.5 * TICK * (before - after) / np.where(bend < 0.0, bend, -1.0), is_summit
