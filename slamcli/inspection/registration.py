"""Do colour and depth fit, in place and in time? Where depth jumps, an object ends, and there the picture usually has an edge too.

Depth edges are laid over the picture's gradient, moved by (dx, dy) and by the picture's own motion times a lag: the shift and the lag under
which they lie on most gradient are those of the recording. A shift that is the same in every frame is wrong registration; one that
follows the speed of the picture is a clock.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from slamcli.datasets import Dataset
from slamcli.errors import BadFrame
from slamcli.parallel import ordered_map

BLOCKS, BLOCK_FRAMES = 8, 6  # stretches of consecutive frames that are looked at
AROUND = 4  # colour frames more at both ends of a stretch: the lag may lead there
LINE_STEP = 3  # every third row and column is searched for depth edges
EDGE_POINTS = 200  # of each frame and direction
REACH = 10  # px over which a depth edge may be torn by missing readings
LARGEST_LOSS = 1.5  # px of a near object that a camera may lose at its edge
JUMP = 0.08  # relative change of depth that makes an edge
LARGEST_SHIFT = 20  # px
LONGEST_STEP = 0.05  # [s] over which a picture's motion is trusted to carry an edge
LAGS = np.arange(-0.1, 0.1001, 0.005)  # [s]
FIRST_LAGS = (-0.08, -0.06, -0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08)  # [s]
THINNING = 5  # one point in five decides where the search starts
LEAST_POINTS = 1500
LEAST_CONTRAST = 1.12  # of the best shift over the mean of all: below, the edges do not agree on any shift
SURE_CONTRAST = 1.4  # registered recordings reach 1.5 and more; below, or where a large shift fits best, another size of depth is tried
MAGNIFICATIONS = np.geomspace(0.6, 1.7, 53)  # of depth about the principal point: focal length of colour over that of the depth camera
SMALL_SHIFT = 3  # px
BETTER = 1.2  # times the contrast at 1 that another magnification needs,
STEEPER = 1.05  # times the steepness under the edges at 1, likewise: fewer edges near the centre have more contrast by themselves,
NOT_ONE = 0.04  # and how far from 1 it must be
PLAIN_SHIFT, PLAIN_LAG = 1, 0.0201  # px, [s] within which a sound recording's lie
CLEARLY = 1.04  # times the steepness there that others need: sound recordings reach 1.00, those a frame late have 1.07 and more
LEAST_LAG_CONTRAST = 1.08  # of the best lag over lags 0.05 s away: below, there was too little motion to tell
LARGEST_FLOW_SIDE = 320  # px; optical flow is computed on pictures reduced to this width


@dataclass(frozen=True)
class RegistrationFinding:
    """How depth lies on colour."""

    shift: tuple[float, float] | None  # (dx, dy) [px] by which depth must be moved to fit colour; None = cannot be told
    lag: float | None  # [s] by which depth stamps are late; None = cannot be told
    n_points: int
    magnification: (
        float | None
    )  # by which depth must be enlarged about the principal point to fit colour, where 1 does not; None = 1 fits best
    shift_contrast: float
    lag_contrast: float


@dataclass(frozen=True)
class ColourEdges:
    """Pictures as edges see them: how steep they are along x and y, and how they move. `C` pictures."""

    stamp: np.ndarray  # (C,) float64 [s]
    steepness: np.ndarray  # (2, C, H, W) uint8; along x, along y; 255 = as steep as the steepest 5 % of its picture
    velocity: list[np.ndarray]  # (h, w, 2) float32 [px/s], reduced
    reduction: float


@dataclass(frozen=True)
class DepthEdges:
    """Depth edges of one frame."""

    stamp: float
    xy: np.ndarray  # (N, 2) px
    is_along_y: np.ndarray  # (N,) bool, whether the jump is along y
    depth: np.ndarray  # (N,) float32 [m] of the nearer side
    outward: np.ndarray  # (N,) float32, +1 where the farther side is the one with the larger coordinate, else -1

    def thinned(self, step: int) -> "DepthEdges":
        """Return every `step`-th of them."""
        return DepthEdges(self.stamp, self.xy[::step], self.is_along_y[::step], self.depth[::step], self.outward[::step])


def measure(dataset: Dataset, *, workers: int, blocks: int = BLOCKS) -> RegistrationFinding:
    """Measure shift and lag of a recording's depth in so many stretches of consecutive frames."""
    colours, edges = collect(dataset, workers, blocks)
    n_points = sum(len(e.xy) for e in edges)
    if n_points < LEAST_POINTS or len(colours.stamp) < 3:
        return RegistrationFinding(None, None, n_points, None, 1.0, 1.0)
    lag = _first_guess(colours, edges)
    shift, _ = _best_shift(colours, edges, lag)
    lag, _ = _best_lag(colours, edges, shift)
    shift, lag, is_plain = _or_plainer(colours, edges, *_refine(colours, edges, shift, lag))
    lag, lag_contrast = _best_lag(colours, edges, shift)
    shift, shift_contrast = _best_shift(colours, edges, lag)
    is_shift_sure, is_lag_sure = shift_contrast >= LEAST_CONTRAST, lag_contrast >= LEAST_LAG_CONTRAST or not is_plain
    return RegistrationFinding(
        shift=(float(shift[0]), float(shift[1])) if is_shift_sure else None,
        lag=round(lag, 4) if is_shift_sure and is_lag_sure else None,
        n_points=n_points,
        magnification=magnification_of(dataset, colours, edges)
        if shift_contrast < SURE_CONTRAST or max(map(abs, shift)) > SMALL_SHIFT
        else None,
        shift_contrast=shift_contrast,
        lag_contrast=lag_contrast,
    )


def collect(dataset: Dataset, workers: int, blocks: int) -> tuple[ColourEdges, list[DepthEdges]]:
    """Read stretches of consecutive frames spread over the recording: their pictures' steepness and motion, and their depth edges."""
    n = len(dataset)
    starts = np.unique(np.linspace(0, max(n - BLOCK_FRAMES, 0), blocks).astype(int))
    wanted_depth = sorted({i for start in starts for i in range(start, min(start + BLOCK_FRAMES, n)) if dataset.depth_name[i]})
    wanted_colour = sorted({i for j in wanted_depth for i in range(max(j - AROUND, 0), min(j + AROUND + 1, n))})
    read = zip(wanted_colour, ordered_map(partial(_try, dataset.grey), wanted_colour, workers=workers), strict=True)
    greys = {i: grey for i, grey in read if grey is not None}
    used = [i for i in greys if i + 1 in greys]
    reduction = max(dataset.camera.width / LARGEST_FLOW_SIDE, 1.0)

    def velocity_of(i: int) -> np.ndarray:
        return _velocity(greys[i], greys[i + 1], float(dataset.stamp[i + 1] - dataset.stamp[i]), reduction)

    size = (2, len(used), dataset.camera.height, dataset.camera.width)
    steepness = np.empty(size, dtype=np.uint8)
    for k, pair in enumerate(ordered_map(lambda i: _steepness(greys[i]), used, workers=workers)):
        steepness[0, k], steepness[1, k] = pair
    colours = ColourEdges(np.array(dataset.stamp[used]), steepness, list(ordered_map(velocity_of, used, workers=workers)), reduction)
    rng = np.random.default_rng(0)
    depths = zip(wanted_depth, ordered_map(partial(_try, dataset.depth), wanted_depth, workers=workers), strict=True)
    return colours, [_depth_edges(depth, float(dataset.depth_stamp[i]), rng) for i, depth in depths if depth is not None]


def _try(read: Callable[[int], np.ndarray | None], i: int) -> np.ndarray | None:
    try:
        return read(i)
    except BadFrame:
        return None


def _steepness(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    soft = cv2.GaussianBlur(grey, (0, 0), 1.0)
    along_x, along_y = np.abs(cv2.Sobel(soft, cv2.CV_16S, 1, 0)), np.abs(cv2.Sobel(soft, cv2.CV_16S, 0, 1))
    cap = max(float(np.percentile(np.maximum(along_x, along_y)[::4, ::4], 95)), 1.0)  # no single bright edge may decide
    return cv2.convertScaleAbs(along_x, alpha=255.0 / cap), cv2.convertScaleAbs(along_y, alpha=255.0 / cap)


def _velocity(grey: np.ndarray, following: np.ndarray, seconds: float, reduction: float) -> np.ndarray:
    size = (round(grey.shape[1] / reduction), round(grey.shape[0] / reduction))
    small = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (grey, following)]
    start = np.zeros((*small[0].shape, 2), dtype=np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST).calc(small[0], small[1], start)
    return flow * np.float32(reduction / max(seconds, 1e-3))


def _depth_edges(depth: np.ndarray, stamp: float, rng: np.random.Generator) -> DepthEdges:
    """Find depth jumps along rows and columns, from both sides so that their offsets cancel."""
    points, flags, depths, outward = [], [], [], []
    margin = LARGEST_SHIFT + 2
    height, width = depth.shape
    for along_x in (True, False):
        lines = depth[::LINE_STEP] if along_x else np.ascontiguousarray(depth[:, ::LINE_STEP].T)
        for sign in (1.0, -1.0):
            ahead = lines if sign > 0 else lines[:, ::-1]
            row, column, half_gap = _jumps(ahead)
            across = sign * half_gap + (column if sign > 0 else lines.shape[1] - 1 - column)
            x, y = (across, LINE_STEP * row) if along_x else (LINE_STEP * row, across)
            inside = np.flatnonzero((x >= margin) & (x < width - margin) & (y >= margin) & (y < height - margin))
            if len(inside) > EDGE_POINTS:
                inside = np.sort(rng.choice(inside, EDGE_POINTS, replace=False))
            points.append(np.stack([x[inside], y[inside]], axis=1))
            flags.append(np.full(len(inside), not along_x))
            depths.append(ahead[row, column][inside])
            outward.append(np.full(len(inside), sign, dtype=np.float32))
    return DepthEdges(
        stamp, np.concatenate(points).astype(np.float32), np.concatenate(flags), np.concatenate(depths), np.concatenate(outward)
    )


def _jumps(lines: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find readings in lines (h, w) whose next reading to the right, at most REACH away, is much farther.

    Returns row, column and the way from there to where the near object ends: cameras lose a pixel or so of it.
    """
    width = lines.shape[1]
    column = np.where(np.isfinite(lines), np.arange(width), width)
    following = np.full_like(column, width)
    following[:, :-1] = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1][:, 1:]
    beyond = np.take_along_axis(lines, np.minimum(following, width - 1), axis=1)
    gap = following - np.arange(width)
    row, at = np.nonzero((gap <= REACH) & (following < width) & (beyond > lines * (1.0 + JUMP)))
    return row, at, np.minimum(0.5 * gap[row, at], LARGEST_LOSS)


def _at_lag(colours: ColourEdges, edges: list[DepthEdges], lag: float) -> np.ndarray:
    """Move every depth edge to the time of the picture nearest to its true time; give its place in that picture's steepness, (N,) int64."""
    _, n, height, width = colours.steepness.shape
    places = []
    for e in edges:
        time = e.stamp - lag
        k = int(np.abs(colours.stamp - time).argmin())
        seconds = float(colours.stamp[k] - time)
        if abs(seconds) > LONGEST_STEP:
            continue
        velocity = colours.velocity[k]
        x, y = (np.clip((e.xy[:, c] / colours.reduction).astype(np.int64), 0, velocity.shape[1 - c] - 1) for c in (0, 1))
        xy = np.rint(e.xy + velocity[y, x] * np.float32(seconds)).astype(np.int64)
        column = np.clip(xy[:, 0], LARGEST_SHIFT, width - 1 - LARGEST_SHIFT)
        row = np.clip(xy[:, 1], LARGEST_SHIFT, height - 1 - LARGEST_SHIFT)
        places.append(((e.is_along_y * n + k) * height + row) * width + column)
    return np.concatenate(places) if places else np.empty(0, dtype=np.int64)


def _score(colours: ColourEdges, places: np.ndarray, dx: int, dy: int) -> float:
    """Return the mean steepness under the edges when moved by (dx, dy) [px]."""
    return float(colours.steepness.reshape(-1)[places + (dy * colours.steepness.shape[3] + dx)].mean()) if len(places) else 0.0


def _first_guess(colours: ColourEdges, edges: list[DepthEdges]) -> float:
    """Find the lag near which the best shift is best, on a coarse lattice and a part of the points: far off, neither is found alone."""
    few = [e.thinned(THINNING) for e in edges]
    best = {}
    for lag in FIRST_LAGS:
        places = _at_lag(colours, few, lag)
        best[lag] = max(_score(colours, places, dx, dy) for dx in _steps(4) for dy in _steps(4))
    return max(best, key=best.__getitem__)


def _best_shift(colours: ColourEdges, edges: list[DepthEdges], lag: float) -> tuple[tuple[int, int], float]:
    places = _at_lag(colours, edges, lag)
    coarse = {(dx, dy): _score(colours, places, dx, dy) for dx in _steps(3) for dy in _steps(3)}
    x, y = max(coarse, key=coarse.__getitem__)
    fine = {(dx, dy): _score(colours, places, dx, dy) for dx in range(x - 2, x + 3) for dy in range(y - 2, y + 3)}
    best = max(fine, key=fine.__getitem__)
    return best, fine[best] / max(float(np.mean(list(coarse.values()))), 1e-9)


def magnification_of(dataset: Dataset, colours: ColourEdges, edges: list[DepthEdges]) -> float | None:
    """Find the magnification under which depth edges lie on the picture's, where that is clear and not 1."""
    height, width = colours.steepness.shape[2:]
    centre = np.array([dataset.camera.cx, dataset.camera.cy], dtype=np.float32)
    contrast, steepness = {}, {}
    for factor in (1.0, *MAGNIFICATIONS):
        moved = []
        for e in edges:
            xy = centre + np.float32(factor) * (e.xy[::2] - centre)
            inside = ((xy > LARGEST_SHIFT) & (xy < np.array([width, height]) - 1 - LARGEST_SHIFT)).all(axis=1)
            moved.append(DepthEdges(e.stamp, xy[inside], e.is_along_y[::2][inside], e.depth[::2][inside], e.outward[::2][inside]))
        places = _at_lag(colours, moved, 0.0)
        if len(places) >= LEAST_POINTS:
            scores = [_score(colours, places, dx, dy) for dx in _steps(3) for dy in _steps(3)]
            contrast[factor], steepness[factor] = max(scores) / max(float(np.mean(scores)), 1e-9), max(scores)
    steeper = [factor for factor in contrast if steepness[factor] > STEEPER * steepness.get(1.0, np.inf)]
    best = max(steeper, key=contrast.__getitem__, default=1.0)
    is_inside = MAGNIFICATIONS[1] < best < MAGNIFICATIONS[-2]  # at the ends few edges are left
    is_clear = contrast.get(best, 0.0) > BETTER * contrast.get(1.0, np.inf) and contrast[best] >= SURE_CONTRAST
    return float(best) if is_inside and is_clear and abs(best - 1.0) > NOT_ONE else None


def _refine(colours: ColourEdges, edges: list[DepthEdges], shift: tuple[int, int], lag: float) -> tuple[tuple[int, int], float]:
    """Search both together nearby: while the picture moves one way, a shift passes for a lag, and one at a time they stop half-way."""
    found = {}
    for t in LAGS[np.abs(LAGS - lag) < 0.0301]:
        places = _at_lag(colours, edges, float(t))
        for dx in range(-3, 4):
            for dy in range(-3, 4):
                moved = (
                    int(np.clip(shift[0] + dx, -LARGEST_SHIFT, LARGEST_SHIFT)),
                    int(np.clip(shift[1] + dy, -LARGEST_SHIFT, LARGEST_SHIFT)),
                )
                found[moved, float(t)] = _score(colours, places, *moved)
    return max(found, key=found.__getitem__)


def _or_plainer(colours: ColourEdges, edges: list[DepthEdges], shift: tuple[int, int], lag: float) -> tuple[tuple[int, int], float, bool]:
    """Return the plainest shift and lag that fit about as well as those found: of a sound recording, else of one that is late alone.

    Many pairs fit nearly as well while the picture moves evenly, and the search may end at any of them. The flag says whether they are
    those of a sound recording.
    """
    near = range(-PLAIN_SHIFT, PLAIN_SHIFT + 1)
    registered: dict[tuple[tuple[int, int], float], float] = {}
    for t in LAGS[::2]:
        places = _at_lag(colours, edges, float(t))
        registered |= {((dx, dy), float(t)): _score(colours, places, dx, dy) for dx in near for dy in near}
    plain = {pair: score for pair, score in registered.items() if abs(pair[1]) <= PLAIN_LAG}
    best, score = (shift, lag), _score(colours, _at_lag(colours, edges, lag), *shift)
    for plainer in (registered, plain):
        other = max(plainer, key=plainer.__getitem__)
        if score <= CLEARLY * plainer[other]:
            best, score = other, plainer[other]
    return *best, best in plain


def _steps(step: int) -> range:
    reach = (LARGEST_SHIFT - 2) // step * step
    return range(-reach, reach + 1, step)


def _best_lag(colours: ColourEdges, edges: list[DepthEdges], shift: tuple[int, int]) -> tuple[float, float]:
    scores = np.array([_score(colours, _at_lag(colours, edges, lag), *shift) for lag in LAGS])
    scores = np.convolve(np.pad(scores, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    best = int(scores.argmax())
    away = scores[np.abs(np.abs(LAGS - LAGS[best]) - 0.05) < 0.011]
    return float(LAGS[best]), float(scores[best] / max(float(away.mean()), 1e-9))
