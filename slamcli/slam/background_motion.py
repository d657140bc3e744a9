"""How the camera moved against what stands still, where most of what it sees may move along.

From frame to frame the motions of camera and walker differ by less than the noise of what is far; so frames are compared over a third of a
second, anchor by anchor, and those between follow. Of each step several motions are kept (`background_step.py`), and the steadiest path
through them is taken: one wrong step alone would lead all those after it astray.
"""

from collections.abc import Callable, Iterable

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Words
from slamcli.slam.background_step import Judgement, StepFinder, is_poor, swerve

SPACING = 0.35  # [s] from anchor to anchor: a walker has gone 0.3 m, ten times the noise of depth at 3 m
SWERVE_COST, SWERVE_MOST = 0.1, 3.0  # share of the surface that a swerve is worth, and how many of them at most
# The same, once what moves is left out: one abrupt swerve is to cost no less than the two, of 3 each, of a fast turn that ends by and by. While
# people are in view, a step that shows next to nothing else may be wrong, and must not lead those around it astray.
SWERVE_MOST_LATER = 6.0


class BackgroundMotion:
    """Estimates the camera's motion against the static world between frames of a recording."""

    def __init__(
        self, features: Features, words: Words, depth: CoarseImages, camera: Camera, sensor: SensorConfig, rng: np.random.Generator
    ) -> None:
        """Take the features, their words and the coarse depth images of a recording."""
        self._stamp = features.stamp
        self._shows_depth = np.array([bool(depth[frame].any()) for frame in range(len(features.stamp))], dtype=bool)
        self._steps = StepFinder(features, words, depth, camera, sensor, rng)

    def poses(self, progress: Callable[[range], Iterable[int]] = iter, *, before: np.ndarray | None = None) -> np.ndarray:
        """Estimate T_wc (F, 4, 4) of all frames, the first at the origin; local motion is right, drift adds up.

        before : what an earlier round estimated, whose motions are tried too
        """
        anchors = anchor_frames(self._stamp, self._shows_depth)
        steps, scale = list[list[Judgement]](), list[float]()
        for k in progress(range(1, len(anchors))):
            scale.append(self._lasts(anchors, k) / self._lasts(anchors, k - 1) if k > 1 else 1.0)
            expected = [_scaled(one.T, scale[-1]) for one in steps[-1]] if steps else []
            steps.append(self._steps.candidates(anchors[k - 1], anchors[k], self._tried(anchors, k, before), expected))
        # At its beginning, a recording has no step before that tells what to expect.
        n_poor = next((k for k, found in enumerate(steps) if not is_poor(found[0])), 0)
        for k in reversed(range(n_poor)):
            expected = [_scaled(one.T, 1.0 / scale[k + 1]) for one in steps[k + 1]]
            steps[k] = self._steps.more(anchors[k], anchors[k + 1], steps[k], expected)
        T_wc = np.tile(np.eye(4), (len(self._stamp), 1, 1))
        for k, T in enumerate(_steadiest(steps, scale, most=SWERVE_MOST if before is None else SWERVE_MOST_LATER), start=1):
            T_wc[anchors[k]] = product(T_wc[anchors[k - 1]], se3.inverse(T))
        for k in progress(range(1, len(anchors))):
            for i in range(anchors[k - 1] + 1, anchors[k]):
                self._place_between(T_wc, anchors[k - 1], anchors[k], i)
        return T_wc

    def _lasts(self, anchors: list[int], k: int) -> float:
        """Return how long step `k`, from anchor k - 1 to anchor k, lasts [s]."""
        return self._stamp[anchors[k]] - self._stamp[anchors[k - 1]]

    def _tried(self, anchors: list[int], k: int, before: np.ndarray | None) -> list[np.ndarray]:
        """List motions that are tried for step `k` in any case: none, and what an earlier round found of it and of the step after it."""
        tried = [np.eye(4)]
        if before is not None:
            tried.append(_motion(before, anchors[k - 1], anchors[k]))
            if k + 1 < len(anchors):
                tried.append(_scaled(_motion(before, anchors[k], anchors[k + 1]), self._lasts(anchors, k) / self._lasts(anchors, k + 1)))
        return tried

    def _place_between(self, T_wc: np.ndarray, first: int, last: int, i: int) -> None:
        """Place a frame between two anchors: near where even motion would have it, refined against the nearer."""
        stamp = self._stamp
        share = (stamp[i] - stamp[first]) / (stamp[last] - stamp[first])
        reference = first if share < 0.5 else last
        expected = product(se3.inverse(se3.interpolate(T_wc[first], T_wc[last], share)), T_wc[reference])
        judged = self._steps.near(reference, i, expected)
        best = max(judged, key=lambda one: one.score - SWERVE_COST * min(swerve(one.T, expected), SWERVE_MOST))
        T_wc[i] = product(T_wc[reference], se3.inverse(best.T))


def _motion(T_wc: np.ndarray, reference: int, i: int) -> np.ndarray:
    """Return the motion T_ir from a reference to frame i."""
    return product(se3.inverse(T_wc[i]), T_wc[reference])


def _scaled(T: np.ndarray, share: float) -> np.ndarray:
    """Return a share of a motion."""
    return se3.exp(share * se3.log(T))


def _steadiest(steps: list[list[Judgement]], scale: list[float], *, most: float) -> list[np.ndarray]:
    """Choose one candidate of each step, so that most speaks for all of them together and the motion changes least (R. Bellman, 1957).

    scale : how long each step lasts, in times of the one before; most : swerves that a change counts as
    """
    total, came_from = [np.array([one.score for one in candidates]) for candidates in steps], list[np.ndarray]()
    for k in range(1, len(steps)):
        cost = np.array([[min(swerve(one.T, _scaled(other.T, scale[k])), most) for other in steps[k - 1]] for one in steps[k]])
        through = total[k - 1][None, :] - SWERVE_COST * cost
        came_from.append(through.argmax(axis=1))
        total[k] = total[k] + through.max(axis=1)
    chosen = [int(total[-1].argmax())] if steps else []
    for origin in reversed(came_from):
        chosen.append(int(origin[chosen[-1]]))
    return [candidates[number].T for candidates, number in zip(steps, reversed(chosen), strict=True)]


def anchor_frames(stamp: np.ndarray, shows_depth: np.ndarray) -> list[int]:
    """List frames SPACING apart or just more that show depth (F,), the first and the last of all among them."""
    anchors = [0]
    while anchors[-1] < len(stamp) - 1:
        following = max(int(np.searchsorted(stamp, stamp[anchors[-1]] + SPACING - 1e-6)), anchors[-1] + 1)
        ahead = np.flatnonzero(shows_depth[following:])
        anchors.append(min(following + int(ahead[0]) if len(ahead) else len(stamp) - 1, len(stamp) - 1))
    return anchors
