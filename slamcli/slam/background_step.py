"""How the camera moved from one frame to another against what stands still, where most of what it sees may move along.

Features that move together say nothing of who moves: somebody walking before the camera shows more of them than the room behind. What
tells is extent. A person has less than a square metre of surface, a room many. So motions are judged by the surface, in square metres, that
two depth images show in the same place, less the surface that one sees and the other looks through.

Motions tried: as before, none, what samples of three matches say (drawn by the surface that each match stands for), and, where none of
these explains what is seen, a grid around the motion expected. Each is refined by the matches that agree and by depth ICP, near surfaces
counting less than far ones. M. Fischler, R. Bolles, CACM 1981, doi:10.1145/358669.358692; Y. Chen, G. Medioni, 1992 (depth/icp.py).
"""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.depth import icp, icp_kernels
from slamcli.depth.coarse_images import CoarseImages
from slamcli.depth.icp import OrientedPoints, Pass, PosePrior
from slamcli.depth.icp_kernels import PoseEquations
from slamcli.estimation import camera_pose, minimal_solvers
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.estimation.measurements import Measurements
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_noise import DepthNoise
from slamcli.schema import Features, Words
from slamcli.slam import background_motion_kernels as kernels
from slamcli.sparse_map import map_adjustment
from slamcli.vision import hamming

CELLS = 16, 12  # columns and rows of the image that share their surface among the matches in them
CHI2_SAMPLE, CHI2_AGREE = 9.0, 16.0  # squared distance [sigma^2] of a match that agrees with a sampled motion, and with one to be refined
SAMPLES, HYPOTHESES = 256, 3  # of three matches; best motions taken in turn, each without the matches of those before
REFINED = 3  # best motions that are refined
LEAST = 10  # matches that a refinement needs
MAX_DISTANCE, RATIO = 64, 0.85  # of descriptors, as in the match stage, a little looser: frames lie farther apart
FLATNESS = DepthNoise(base=0.015, quadratic=0.006)  # distance between surfaces that are the same: several sigma of a reading, and the pose
SWERVE_M, SWERVE_RAD = 0.08, 0.08  # [m, rad] by which the motion from anchor to anchor changes now and then
CANDIDATES, ALIKE = 6, 0.01  # motions kept of each step, and the swerve up to which two are one
LOOSE = np.array([0.02] * 3 + [0.01] * 3)  # [m, rad] how far ICP may go where no match holds it
TIGHT = np.array([0.007] * 3 + [0.004] * 3)  # of frames between anchors, whose place is nearly known
POOR_SHARE, POOR_RATIO = 0.4, 10.0  # surface explained, and how many times what contradicts, below which the grid is searched too
GRID_M, GRID_RAD = (-0.2, -0.1, 0.0, 0.1, 0.2), (-0.12, 0.0, 0.12)  # forward, and turned to a side
SCHEDULE = np.array([Pass(4, 0.10, 6, 5e-4), Pass(2, 0.05, 5, 2e-4)])  # with a shorter reach than depth/icp.py
NEAR_VARIANCE = 4.0  # [m^2] at which distance squared a reading's variance is as the sensor's; nearer counts less
FAR = 4.0  # [m] beyond which it does not count more
KEPT = 48  # frame_points


@dataclass(frozen=True)
class Common:
    """What two frames have in common: matches and depth."""

    x_r: np.ndarray  # (N, 3) [m] matched points in the reference
    x_i: np.ndarray  # (N, 3) [m] the same in the frame, NaN where it has no depth
    measured: Measurements  # N rows, of the frame, with the noise of both
    weight: np.ndarray  # (N,) [m^2] surface that each stands for
    source: OrientedPoints  # of the reference
    target: OrientedPoints  # of the frame
    surface: float  # [m^2] that each shows, on average


@dataclass(frozen=True)
class Judgement:
    """A motion T_ir from the reference to the frame and what speaks for it, as shares of the surface seen."""

    T: np.ndarray  # (4, 4)
    score: float
    explained: float
    contradicted: float
    agrees: np.ndarray  # (N,) bool, matches


class StepFinder:
    """Finds what motions from one frame of a recording to another explain the surface that both see."""

    def __init__(
        self, features: Features, words: Words, depth: CoarseImages, camera: Camera, sensor: SensorConfig, rng: np.random.Generator
    ) -> None:
        """Take the features, their words and the coarse depth images of a recording."""
        self._features, self._words, self._depth, self._camera, self._sensor, self._rng = features, words, depth, camera, sensor, rng
        self._pinhole = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        self._frame_points: OrderedDict[int, OrientedPoints] = OrderedDict()

    def candidates(self, reference: int, i: int, tried: list[np.ndarray], expected: list[np.ndarray]) -> list[Judgement]:
        """Find the motions from one anchor to the next for which most speaks, each unlike the others, the best first.

        expected : as the motion before would have it, of each of its candidates
        """
        common = self._common(reference, i)
        found = self._refine_best(common, [*tried, *expected, *self._sampled(common)], LOOSE)
        if not expected or is_poor(max(found, key=_score)):
            around = [se3.exp(np.array([0.0, 0.0, z, 0.0, turn, 0.0])) for z in GRID_M for turn in GRID_RAD]
            start = expected[0] if expected else np.eye(4)
            found += self._refine_best(common, [product(step, start) for step in around], LOOSE)
        return _best_unlike(found)

    def more(self, reference: int, i: int, found: list[Judgement], expected: list[np.ndarray]) -> list[Judgement]:
        """Add to the motions found for a step those that are expected of it for another reason."""
        return _best_unlike(found + self._refine_best(self._common(reference, i), expected, LOOSE))

    def near(self, reference: int, i: int, expected: np.ndarray) -> list[Judgement]:
        """Judge the motion expected from a frame to another near by, and refine it."""
        return self._refine_best(self._common(reference, i), [expected], TIGHT)

    def _refine_best(self, common: Common, tried: list[np.ndarray], sigma: np.ndarray) -> list[Judgement]:
        """Judge motions and refine the most promising; returns all that were judged."""
        judged = [self._judge(common, T) for T in tried]
        best = sorted(judged, key=lambda judgement: -judgement.score)[:REFINED]
        return judged + [self._judge(common, T) for start in best for T in self._refined(common, start, sigma)]

    def _judge(self, common: Common, T: np.ndarray) -> Judgement:
        """Judge a motion by both frames: a surface that comes nearer hides its old place from the one and is looked through by the other."""
        T = np.ascontiguousarray(T)
        there = _explain(T, common.source, common.target)
        back = _explain(np.ascontiguousarray(se3.inverse(T)), common.target, common.source)
        explained, contradicted = (0.5 * (one + other) for one, other in zip(there, back, strict=True))
        agrees = np.zeros(len(common.weight), dtype=np.bool_)
        _, matched = kernels.vote(T[None], _votes(common, np.arange(len(agrees))), self._pinhole, CHI2_AGREE, agrees)
        surface = max(common.surface, 1e-9)
        return Judgement(T, (explained - contradicted + matched) / surface, explained / surface, contradicted / surface, agrees)

    def _refined(self, common: Common, start: Judgement, sigma: np.ndarray) -> list[np.ndarray]:
        """Refine a motion by the matches that agree with it, and then by depth too."""
        T, prior, found = start.T, PosePrior(start.T, np.diag(1.0 / (sigma * sigma))), []
        rows = np.flatnonzero(start.agrees)
        if len(rows) >= LEAST:
            estimate = self._refined_by_matches(T, common, rows)
            T, prior = estimate.T_cw, PosePrior(estimate.T_cw, estimate.information)
            found.append(T)
        if min(len(common.source), len(common.target)) >= LEAST:
            found.append(_align(T, common.source, common.target, prior))
        return found

    def _refined_by_matches(self, T: np.ndarray, common: Common, rows: np.ndarray) -> PoseEstimate:
        return camera_pose.refine_pose(T, common.x_r[rows], common.measured.take(rows), self._camera)

    def _sampled(self, common: Common) -> list[np.ndarray]:
        """Draw samples of three matches, take the motion that matches of most surface agree on, leave these out, and again."""
        found, left = [], np.ones(len(common.weight), dtype=bool)
        for _ in range(HYPOTHESES):
            rows = np.flatnonzero(left)
            whole = rows[np.isfinite(common.x_i[rows, 0])]
            if len(whole) < LEAST:
                break
            bounds = np.cumsum(common.weight[whole])
            drawn = np.searchsorted(bounds, bounds[-1] * self._rng.random((SAMPLES, 3))).clip(0, len(whole) - 1)
            T = np.ascontiguousarray(minimal_solvers.rigid3(common.x_r[whole[drawn]], common.x_i[whole[drawn]]))
            agrees = np.zeros(len(rows), dtype=np.bool_)
            best, _ = kernels.vote(T, _votes(common, rows), self._pinhole, CHI2_SAMPLE, agrees)
            if best < 0 or agrees.sum() < LEAST // 2:
                break
            found.append(self._refined_by_matches(np.vstack([T[best], [0.0, 0.0, 0.0, 1.0]]), common, rows[agrees]).T_cw)
            left[rows[agrees]] = False
        return found

    def _common(self, reference: int, i: int) -> Common:
        """Match two frames and gather what both measured."""
        in_r, in_i = self._matches(reference, i)
        measured_r, measured_i = (map_adjustment.measure(self._features, rows, self._sensor) for rows in (in_r, in_i))
        has = np.isfinite(measured_r.depth)
        xy, depth = measured_i.xy[has], measured_i.depth[has]
        x_r = self._camera.backproject(measured_r.xy[has], measured_r.depth[has])
        cell = (xy * np.array(CELLS) / [self._camera.width, self._camera.height]).astype(np.int64).clip(0, np.array(CELLS) - 1)
        number = cell[:, 1] * CELLS[0] + cell[:, 0]
        share = np.bincount(number, minlength=CELLS[0] * CELLS[1])[number]
        cell_rad2 = self._camera.width * self._camera.height / (CELLS[0] * CELLS[1] * self._camera.fx * self._camera.fy)
        source, target = self._surface_points(reference), self._surface_points(i)
        return Common(
            x_r=np.ascontiguousarray(x_r),
            x_i=self._camera.backproject(xy, depth),
            measured=Measurements(
                xy=np.ascontiguousarray(xy),
                depth=np.ascontiguousarray(depth),
                sigma_px=np.sqrt(2.0) * measured_i.sigma_px[has],
                sigma_z=np.sqrt(measured_r.sigma_z[has] ** 2 + np.nan_to_num(measured_i.sigma_z[has]) ** 2),
            ),
            weight=cell_rad2 * x_r[:, 2] ** 2 / np.maximum(share, 1),
            source=source,
            target=target,
            surface=0.5 * sum(kernels.surface(one.xyz, one.normal, one.pinhole) for one in (source, target)),
        )

    def _matches(self, reference: int, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Match the features of two frames; returns rows of the table of all features."""
        first_r, first_i = (int(self._features.offset[frame]) for frame in (reference, i))
        in_r, in_i = (slice(int(self._features.offset[frame]), int(self._features.offset[frame + 1])) for frame in (reference, i))
        features, words = self._features, self._words
        here, there = (hamming.Described(features.desc[rows], features.angle[rows], words.node(rows)) for rows in (in_i, in_r))
        row, _ = hamming.match_nodes(here, there, max_distance=MAX_DISTANCE, ratio=RATIO)
        return first_r + row[:, 1].astype(np.int64), first_i + row[:, 0].astype(np.int64)

    def _surface_points(self, frame: int) -> OrientedPoints:
        if frame not in self._frame_points:
            self._frame_points[frame] = icp.surface_points(self._depth[frame], self._camera, self._sensor)
            if len(self._frame_points) > KEPT:
                self._frame_points.popitem(last=False)
        return self._frame_points[frame]


def _votes(common: Common, rows: np.ndarray) -> kernels.WeightedMatches:
    """Return matches `rows` as the voting kernel takes them."""
    m = common.measured.take(rows)
    return kernels.WeightedMatches(common.x_r[rows], m.xy, m.depth, 1.0 / m.sigma_px, 1.0 / m.sigma_z, common.weight[rows])


def _score(one: Judgement) -> float:
    return one.score


def is_poor(best: Judgement) -> bool:
    """Say whether a motion explains so little, or contradicts so much, that another may be the true one."""
    return best.explained < POOR_RATIO * best.contradicted or best.explained < POOR_SHARE


def _best_unlike(found: list[Judgement]) -> list[Judgement]:
    """Keep the best motions, each unlike those before it."""
    kept: list[Judgement] = []
    for one in sorted(found, key=_score, reverse=True):
        if len(kept) < CANDIDATES and all(swerve(one.T, other.T) > ALIKE for other in kept):
            kept.append(one)
    return kept


def swerve(T: np.ndarray, expected: np.ndarray) -> float:
    """Measure by how much a motion differs from another: 1 for a change by SWERVE_M or SWERVE_RAD, 4 for twice as much."""
    e = se3.log(product(T, se3.inverse(expected)))
    return float(((e[:3] / SWERVE_M) ** 2).sum() + ((e[3:] / SWERVE_RAD) ** 2).sum())


def _explain(T: np.ndarray, source: OrientedPoints, target: OrientedPoints) -> tuple[float, float]:
    return kernels.explain(T, source.points, target.points, target.view, FLATNESS)


def _align(T: np.ndarray, source: OrientedPoints, target: OrientedPoints, prior: PosePrior) -> np.ndarray:
    """Move the source's surface onto the target's, all surface counting alike; `prior` as in icp.align."""
    T = np.array(T, dtype=np.float64, order="C")
    pull = product(prior.information, se3.log(product(prior.T, se3.inverse(T))))
    by_surface = (one.points._replace(variance=_variance(one)) for one in (source, target))
    known, found = PoseEquations(np.ascontiguousarray(prior.information), pull), PoseEquations(np.zeros((6, 6)), np.zeros(6))
    icp_kernels.align(T, *by_surface, target.view, SCHEDULE, icp.RULE, known, found)
    return se3.orthonormalize(T)


def _variance(points: OrientedPoints) -> np.ndarray:
    """Return readings (N,) weights as of the surface that they stand for, which grows with the square of the distance."""
    z = points.xyz[:, 2]
    sigma = np.sqrt(points.variance) + np.float32(0.005)
    return np.square(sigma) * np.float32(NEAR_VARIANCE) / np.square(np.minimum(z, np.float32(FAR)))
