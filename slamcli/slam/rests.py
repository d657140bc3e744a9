"""Where the camera stands still: images of a rest differ by noise alone, so all of them were taken from one pose.

Each frame is first compared with the one before it, by the matches that are there anyway, then with the first of its rest, which a slow
motion leaves step by step. Between two images of one view the matched features differ by a shift, a turn and a growth about the middle of
the image, each known to some hundredths of a pixel from hundreds of features; moving along the view shows in the growth.
"""

from dataclasses import dataclass

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Matches, Rests, Words
from slamcli.vision import hamming

STILL_PX = 0.2  # [px] by which no part of an image moves: 0.8 mm at 2 m
STILL_SIGMA, MOST_SIGMA = 4.0, 0.2  # more of it may be noise: so many standard errors of the motion, which is to be known to so much [px]
AGREE_PX = 2.0  # [px] from where the motion takes a feature to where it is seen
LEAST_MATCHES = 40
LEAST_SHARE = 0.6  # of the matches that agree: where less does, most of the view moves, and the rest may be somebody else's
LEAST_SECONDS = 1.0  # a hand that turns back rests for less
ROUNDS = 3  # of fitting the motion to the matches that agree
MAX_DISTANCE, RATIO = 64, 0.8  # of descriptors, as in the match stage
UNMATCHED = np.inf
NONE = Rests()
SAMPLES = 32  # frames of a rest whose poses are found anew: their median is within a fifth of what one errs by


def find(features: Features, words: Words, matches: Matches, camera: Camera) -> Rests:
    """List the spans of frames over which the camera stands still.

    features : of what stands still; those out of sight match nothing
    """
    looks = _Looks(features, words, camera)
    is_still = np.zeros(len(features.stamp), dtype=bool)  # since the frame before
    for p, (i, j) in enumerate(matches.pair):
        if i == j + 1:
            is_still[i] = looks.moved(i, j, matches.row[matches.offset[p] : matches.offset[p + 1]]) < 1.0
    spans, first = [], 0
    for i in range(1, len(is_still) + 1):
        if i < len(is_still) and is_still[i] and looks.moved(i, first) < 1.0:
            continue
        if features.stamp[i - 1] - features.stamp[first] >= LEAST_SECONDS:
            spans.append((first, i - 1))
        first = i
    return Rests(rest_span=np.array(spans, dtype=np.int32).reshape(-1, 2))


def within(rests: Rests, n: int, *, with_last: bool) -> np.ndarray:
    """Mark the frames (n,) of rests but for the first, and the last unless asked for."""
    inside = np.zeros(n, dtype=bool)
    for first, last in rests.rest_span:
        inside[first + 1 : last + with_last] = True
    return inside


def left_out(rests: Rests, n: int) -> np.ndarray:
    """Mark the frames (n,) of rests that need no look of their own, as enough others of the same rest are looked at."""
    out = np.zeros(n, dtype=bool)
    for first, last in rests.rest_span:
        out[first : last + 1] = True
        out[np.linspace(first, last, min(SAMPLES, last - first + 1)).astype(np.int64)] = False
    return out


def one_pose(rests: Rests, T_wc: np.ndarray, is_measured: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Give the frames of each rest the median of the poses measured of them.

    T_wc : (F, 4, 4) in the world of `segment` (F,), which is -1 where a frame is lost; is_measured : (F,)
    Returns new poses; frames of a rest that are lost, or in another segment than most, keep theirs.
    """
    T_wc = T_wc.copy()
    for first, last in rests.rest_span:
        frames = np.arange(first, last + 1)
        frames = frames[segment[frames] >= 0]
        if len(frames) == 0:
            continue
        frames = frames[segment[frames] == np.bincount(segment[frames]).argmax()]
        measured = frames[is_measured[frames]] if is_measured[frames].any() else frames
        T_wr = T_wc[measured[len(measured) // 2]]
        T_wc[frames] = product(T_wr, se3.exp(np.median(se3.log(product(se3.inverse(T_wr), T_wc[measured])), axis=0)))
    return T_wc


@dataclass(frozen=True)
class _Looks:
    """The frames' features, compared two frames at a time."""

    features: Features
    words: Words
    camera: Camera

    def moved(self, i: int, j: int, row: np.ndarray | None = None) -> float:
        """Find by how much the view moved from frame j to frame i, in times of what a view at rest does; UNMATCHED where they have too little in common.

        row : (N, 2) features of i and j that match, if that is known
        """
        in_i, in_j = (slice(int(self.features.offset[frame]), int(self.features.offset[frame + 1])) for frame in (i, j))
        if row is None:
            f, words = self.features, self.words
            here, there = (hamming.Described(f.desc[rows], f.angle[rows], words.node(rows)) for rows in (in_i, in_j))
            row, _ = hamming.match_nodes(here, there, max_distance=MAX_DISTANCE, ratio=RATIO)
        xy_i, xy_j = self.features.xy[in_i][row[:, 0]], self.features.xy[in_j][row[:, 1]]
        in_sight = (xy_i[:, 0] > -self.camera.width) & (xy_j[:, 0] > -self.camera.width)
        middle = np.array([self.camera.width, self.camera.height]) / 2.0
        return _shift(xy_j[in_sight].astype(np.float64) - middle, xy_i[in_sight].astype(np.float64) - middle, middle)


def _shift(before: np.ndarray, after: np.ndarray, corner: np.ndarray) -> float:
    """Fit shift, turn and growth about the origin to points (N, 2); returns how far they take the farthest corner, in times of what is still."""
    step, motion = after - before, np.zeros(4)
    if len(step) < LEAST_MATCHES:
        return UNMATCHED
    motion[:2] = np.median(step, axis=0)
    if np.abs(motion[:2]).max() > AGREE_PX:
        return UNMATCHED
    for _ in range(ROUNDS):
        agrees = np.linalg.norm(step - _moved(motion, before), axis=1) < AGREE_PX
        if agrees.sum() < max(LEAST_MATCHES, LEAST_SHARE * len(step)):
            return UNMATCHED
        motion = _fit(before[agrees], step[agrees])
    residual, spread = step[agrees] - _moved(motion, before[agrees]), np.square(before[agrees] - before[agrees].mean(axis=0)).sum()
    sigma = np.sqrt(0.5 * np.square(residual).sum(axis=1).mean() * (1.0 / agrees.sum() + (corner * corner).sum() / max(spread, 1.0)))
    if sigma > MOST_SIGMA:
        return UNMATCHED
    corners = corner * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    return float(np.linalg.norm(_moved(motion, corners), axis=1).max() / max(STILL_PX, STILL_SIGMA * sigma))


def _fit(x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Fit a motion (shift, growth, turn) to the steps (N, 2) of points: linear least squares, in closed form about their mean."""
    mean_x, mean_step = x.mean(axis=0), step.mean(axis=0)
    about = x - mean_x
    spread = max(float((about * about).sum()), 1e-9)
    growth = float((about * step).sum()) / spread
    turn = float((about[:, 0] * step[:, 1] - about[:, 1] * step[:, 0]).sum()) / spread
    return np.array([*(mean_step - _moved(np.array([0.0, 0.0, growth, turn]), mean_x[None])[0]), growth, turn])


def _moved(motion: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the steps (N, 2) of points under a motion (shift, growth, turn)."""
    return motion[:2] + motion[2] * x + motion[3] * np.column_stack([-x[:, 1], x[:, 0]])
