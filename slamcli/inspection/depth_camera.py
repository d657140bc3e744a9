"""Find the depth camera of a recording whose depth was never registered to colour: its focal length, and where it sits.

Where depth jumps an object ends, and there the picture has an edge. Under the right focal length, turn and offset the depth edges, each moved
by its own depth, lie on the picture's; near and far ones tell the offset from the turn. The place of the principal point is taken for the
middle of the image, as a turn does nearly the same. Halves of the recording, each for itself, say how sure the result is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize

from slamcli.datasets import Dataset
from slamcli.geometry import se3
from slamcli.inspection import registration
from slamcli.inspection.registration import Colours, Edges

BLUR = (8.0, 4.0, 2.0, 0.0)  # [px] of the pictures' steepness, from round to round: what is far off is found first
LAGS = (-0.02, -0.01, 0.0, 0.01, 0.02, 0.03)  # [s] by which depth stamps may be late
START_LAG = 0.01  # [s]
LAG_PRICE = 1.0  # [1/s] share of the contrast that a lag must bring
STARTS = (0.75, 0.9, 1.12, 1.37)  # magnifications tried where none is known
# What moves edges by about as far, a pixel or so at a picture of 640: share of the focal length, turns [rad], offsets [m].
STEP = np.array([4e-3, 2e-3, 2e-3, 4e-3, 3e-3, 3e-3])
EVALUATIONS = 400  # of the score at most in each round
BELIEVED = np.array([0.05, 0.05, 0.05, 0.05, 0.05])  # [rad, m] turn and offset are about this at most
CAUTION = 0.004  # of the mean steepness: what a turn or an offset as large as BELIEVED must bring
LEAST_SIGMA = np.array([0.004, 0.002, 0.002, 0.002, 0.002, 0.002])  # of each number: edges of depth and colour differ by half a pixel
# The evidence that is beyond doubt.
LEAST_CONTRAST = 2.0  # steepness under the edges over the mean; wrong ones reach 1.5
BETTER = 1.4  # times the contrast with depth as it is
LEAST_DIFFERENCE = 0.04  # of its focal length from colour's, as a share: depth that was only moved is no other camera's
LARGEST_SIGMA = 0.006  # of the focal length, as a share of it
LARGEST_TURN, LARGEST_OFFSET = 0.06, 0.08  # [rad, m] of a depth camera in one housing with a colour camera


@dataclass(frozen=True)
class DepthCamera:
    """A depth camera as its edges on the pictures tell it, for depth images of the pictures' size."""

    focal: float  # [px]
    focal_sigma: float  # [px]
    centre: tuple[float, float]  # [px] the image's middle
    turn: np.ndarray  # (3,) rotation vector of T_cd [rad]
    offset: np.ndarray  # (3,) of T_cd [m]
    offset_sigma: float  # [m]
    contrast: float  # of the pictures' steepness under the depth edges
    contrast_before: float  # with depth as it is
    focal_of_colour: float  # [px]

    @property
    def is_sure(self) -> bool:
        """Say whether the evidence is beyond doubt."""
        is_possible = np.linalg.norm(self.turn) < LARGEST_TURN and np.linalg.norm(self.offset) < LARGEST_OFFSET
        is_clear = self.contrast >= LEAST_CONTRAST and self.contrast >= BETTER * self.contrast_before
        is_another = abs(self.focal / self.focal_of_colour - 1.0) >= LEAST_DIFFERENCE
        return bool(is_possible and is_clear and is_another and self.focal_sigma <= LARGEST_SIGMA * self.focal)

    @property
    def option(self) -> str:
        """Write it as `recording.depth_camera` has it."""
        numbers = (self.focal, self.focal, *self.centre, *self.offset, *self.turn)
        return " ".join(f"{number:.6g}" for number in numbers)

    @property
    def told(self) -> str:
        """Say in words what was found."""
        turned, aside = np.degrees(np.linalg.norm(self.turn)), 1000 * np.linalg.norm(self.offset)
        return (
            f"depth is of another camera than colour and is registered on reading, as its edges tell: focal length {self.focal:.1f} +- "
            f"{self.focal_sigma:.1f} px, {aside:.0f} +- {1000 * self.offset_sigma:.0f} mm aside, turned by {turned:.1f} degrees"
        )


def find(dataset: Dataset, *, workers: int = 2) -> DepthCamera | None:
    """Find the depth camera of unregistered depth; None where there are too few edges."""
    colours, edges = registration.collect(dataset, workers, registration.BLOCKS)
    if sum(len(e.xy) for e in edges) < registration.LEAST_POINTS:
        return None
    camera, overlay = dataset.camera, _Overlay(dataset, colours, edges, START_LAG)
    magnification = registration.magnification_of(dataset, colours, edges)
    factors = (magnification,) if magnification is not None else STARTS
    starts = [np.array([np.log(camera.fx / factor), 0.0, 0.0, 0.0, 0.0, 0.0]) for factor in factors]
    rough = max((_solve(overlay, start, BLUR[:2]) for start in starts), key=overlay.contrast)
    tried = [(lag, _solve(overlay := _Overlay(dataset, colours, edges, lag), rough, BLUR[2:3]), overlay) for lag in LAGS]
    # In an even motion a lag passes for an offset: without more contrast there is none.
    lag, near, overlay = max(tried, key=lambda one: (1.0 - LAG_PRICE * abs(one[0])) * one[2].contrast(one[1]))
    found = _solve(overlay, near, BLUR[3:])
    halves = np.array([_solve(_Overlay(dataset, colours, edges[part::2], lag), near, BLUR[3:]) for part in (0, 1)])
    sigma = np.maximum(0.5 * np.abs(halves[1] - halves[0]), LEAST_SIGMA)
    as_it_is = np.array([np.log(camera.fx), 0.0, 0.0, 0.0, 0.0, 0.0])
    return DepthCamera(
        focal=float(np.exp(found[0])),
        focal_sigma=float(sigma[0] * np.exp(found[0])),
        centre=(0.5 * (camera.width - 1), 0.5 * (camera.height - 1)),
        turn=found[1:4],
        offset=np.append(found[4:], 0.0),
        offset_sigma=float(np.linalg.norm(sigma[4:])),
        contrast=overlay.contrast(found),
        contrast_before=overlay.contrast(as_it_is),
        focal_of_colour=float(camera.fx),
    )


class _Overlay:
    """Depth edges laid over the pictures nearest in time to them."""

    def __init__(self, dataset: Dataset, colours: Colours, edges: Sequence[Edges], lag: float) -> None:
        self._camera, self._colours, self._steepness, self._mean = dataset.camera, colours, colours.steepness, 1.0
        near = [(e, int(np.abs(colours.stamp - (e.stamp - lag)).argmin())) for e in edges]
        near = [(e, k) for e, k in near if abs(colours.stamp[k] - (e.stamp - lag)) <= registration.LONGEST_STEP]
        self._picture = np.concatenate([np.full(len(e.xy), k) for e, k in near])
        seconds = np.concatenate([np.full(len(e.xy), colours.stamp[k] - (e.stamp - lag)) for e, k in near])
        self._seconds, self._xy = seconds[:, None], np.concatenate([e.xy for e, _ in near]).astype(np.float64)
        self._z = np.concatenate([e.depth for e, _ in near]).astype(np.float64)[:, None]
        self._along = np.concatenate([e.is_along_y for e, _ in near]).astype(np.int64)
        self._velocity = np.stack(colours.velocity)

    def blur(self, sigma: float) -> None:
        """Smooth the pictures' steepness by so many pixels."""
        sharp = self._colours.steepness
        self._steepness = sharp if sigma == 0.0 else np.stack([[cv2.GaussianBlur(one, (0, 0), sigma) for one in way] for way in sharp])
        self._mean = float(self._steepness.mean())

    def contrast(self, numbers: np.ndarray) -> float:
        """Return the mean steepness under the edges over that of the pictures; what falls outside counts as the mean.

        numbers : (6,) logarithm of the focal length, turn [rad], offset in x and y [m]
        """
        xy = self._moved(numbers)
        height, width = self._steepness.shape[2:]
        inside = (xy[:, 0] >= 1.0) & (xy[:, 1] >= 1.0) & (xy[:, 0] < width - 2.0) & (xy[:, 1] < height - 2.0)
        u, v = np.where(inside, xy[:, 0], 1.0), np.where(inside, xy[:, 1], 1.0)
        column, row = u.astype(np.int64), v.astype(np.int64)
        a, b = u - column, v - row
        at = [self._steepness[self._along, self._picture, row + down, column + right] for down in (0, 1) for right in (0, 1)]
        steep = (1 - b) * ((1 - a) * at[0] + a * at[1]) + b * ((1 - a) * at[2] + a * at[3])
        return float(np.where(inside, steep, self._mean).mean()) / self._mean

    def _moved(self, numbers: np.ndarray) -> np.ndarray:
        """Return the raw pixels (N, 2) of the pictures in which the edges lie."""
        camera, focal = self._camera, np.exp(numbers[0])
        middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
        ray = np.concatenate([(self._xy - middle) / focal, np.ones_like(self._z)], axis=1)
        T_cd = transform(numbers[1:4], np.append(numbers[4:], 0.0))
        x_c = se3.transform(T_cd, ray * self._z)
        xy = camera.distort(camera.project(x_c))
        size = np.array(self._velocity.shape[2:0:-1]) - 1
        small = np.clip(np.nan_to_num(xy / self._colours.reduction), 0, size).astype(np.int64)
        return xy + self._velocity[self._picture, small[:, 1], small[:, 0]] * self._seconds


def transform(turn: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return T_cd (4, 4) of a rotation vector [rad] and a translation [m]."""
    T_cd = se3.exp(np.concatenate([np.zeros(3), turn]))
    T_cd[:3, 3] = offset
    return T_cd


def _solve(overlay: _Overlay, start: np.ndarray, blurs: Sequence[float]) -> np.ndarray:
    """Climb to the numbers with the most contrast, on pictures ever less blurred.

    J. Nelder, R. Mead, A simplex method for function minimization, 1965, doi:10.1093/comjnl/7.4.308
    """
    best = start
    for sigma in blurs:
        overlay.blur(sigma)
        origin, step = best, STEP * max(sigma, 1.0)

        def loss(x: np.ndarray, origin: np.ndarray = origin, step: np.ndarray = step) -> float:
            numbers = origin + x * step
            return CAUTION * float(((numbers[1:] / BELIEVED) ** 2).sum()) - overlay.contrast(numbers)

        simplex = np.vstack([np.zeros(6), 2.0 * np.eye(6)])
        options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": EVALUATIONS}
        best = origin + minimize(loss, np.zeros(6), method="Nelder-Mead", options=options).x * step
    return best
