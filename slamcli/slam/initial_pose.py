"""A frame's first pose, from the features matched to the frame before it: by the motion model, else by P3P in RANSAC; [Z] 1.2."""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.estimation import camera_pose
from slamcli.estimation.camera_pose import Ransac
from slamcli.geometry import se3
from slamcli.schema import Matches
from slamcli.sparse_map import landmark_pose
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import SparseMap


@dataclass(frozen=True)
class Correspondences:
    """Features of a frame and the points in the map that they show."""

    row: np.ndarray  # (N,) feature within the frame
    x_w: np.ndarray  # (N, 3) m, world
    landmark: np.ndarray  # (N,) int32, -1 where the point was lifted from the previous frame by its depth alone

    def __len__(self) -> int:
        return len(self.row)


class PreviousFrame:
    """The frame before, with the landmarks that it showed: what the next one is matched with."""

    def __init__(self, sparse_map: SparseMap, matches: Matches) -> None:
        """Take the matches between neighbouring frames."""
        self._sparse_map, self._matches = sparse_map, matches
        self._pair_of = {(int(i), int(j)): p for p, (i, j) in enumerate(matches.pair)}
        self.features: FrameFeatures | None = None
        self.landmark = np.empty(0, dtype=np.int32)  # of each of its features, -1 = none

    def remember(self, frame: FrameFeatures, landmark: np.ndarray) -> None:
        """Keep a frame for the one that follows."""
        self.features, self.landmark = frame, landmark

    def correspondences(self, i: int, T_wp: np.ndarray) -> Correspondences:
        """Find what features of frame `i` show by their matches with the previous frame, whose pose is `T_wp`.

        Matches need no motion model, so fast turns do no harm.
        """
        pair = self._pair_of.get((i, i - 1))
        if pair is None or self.features is None:
            return Correspondences(np.empty(0, np.int32), np.empty((0, 3)), np.empty(0, np.int32))
        match = self._matches.row[self._matches.offset[pair] : self._matches.offset[pair + 1]].astype(np.int32)
        ids = self._sparse_map.resolve(self.landmark[match[:, 1]])
        x_p = self.features.camera.backproject(self.features.xy[match[:, 1]], self.features.depth[match[:, 1]])
        x_w = se3.transform(T_wp, x_p)
        x_w[ids >= 0] = self._sparse_map.lm.xyz[ids[ids >= 0]]
        is_usable = np.isfinite(x_w[:, 0])
        return Correspondences(match[is_usable, 0], x_w[is_usable], ids[is_usable])


def estimate(
    found: Correspondences, predicted: np.ndarray, frame: FrameFeatures, settings: TrackConfig, rng: np.random.Generator
) -> camera_pose.PoseEstimate | None:
    """Estimate a frame's pose from its correspondences, starting from the predicted T_cw; None if fewer than `min_inliers` agree.

    P3P is drawn only where the prediction explains at most half of the correspondences: else no other pose can have as many.
    """
    if len(found) < settings.min_inliers:
        return None
    best = landmark_pose.refine(predicted, found.x_w, frame, found.row)
    if 2 * best.n_inliers <= len(found):
        ransac = Ransac(settings.ransac_rounds, settings.ransac_threshold_px)
        start = camera_pose.ransac_p3p(found.x_w, frame.xy[found.row], frame.camera, rng=rng, ransac=ransac)
        if start is not None:
            best = max(best, landmark_pose.refine(start.T_cw, found.x_w, frame, found.row), key=lambda e: e.n_inliers)
    return best if best.n_inliers >= settings.min_inliers else None
