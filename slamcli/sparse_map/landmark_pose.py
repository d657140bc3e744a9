"""A frame's pose from the landmarks of the map: project them by a predicted pose, match near by, refine the pose; [Z] 1.2."""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.estimation import camera_pose
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.estimation.measurements import Measurements
from slamcli.sparse_map import guided_matching
from slamcli.sparse_map.guided_matching import FrameFeatures, Landmarks, SearchLimits

WIDER = 3.0  # times the search radius, where the first search finds little


@dataclass(frozen=True)
class LandmarkPose:
    """The landmarks found in a frame, and its pose refined on them."""

    landmark: np.ndarray  # (M,) rows of those found
    feature: np.ndarray  # (M,) of the frame, that shows each
    is_visible: np.ndarray  # (L,) bool, whether the frame should show it
    estimate: PoseEstimate | None  # None where fewer were found than wanted

    @property
    def n_found(self) -> int:
        """Return how many landmarks were matched with a feature."""
        return len(self.landmark)

    @property
    def n_agree(self) -> int:
        """Return how many of the matches agree with the refined pose."""
        return 0 if self.estimate is None else self.estimate.n_inliers


def find(
    T_cw: np.ndarray, landmarks: Landmarks, frame: FrameFeatures, limits: SearchLimits, *, wanted: int, enough: int = 0
) -> LandmarkPose:
    """Find a frame's pose near the predicted T_cw (4, 4): project the landmarks, match each with a feature near by, refine on the matches.

    wanted : matches that the pose is refined on at least; enough : matches below which the search is repeated in a wider window
    """
    landmark, feature, is_visible = _match(T_cw, landmarks, frame, limits)
    if len(landmark) < enough:
        landmark, feature, is_visible = _match(T_cw, landmarks, frame, limits.widened(WIDER))
    estimate = refine(T_cw, landmarks.xyz[landmark], frame, feature) if len(landmark) >= wanted else None
    return LandmarkPose(landmark, feature, is_visible, estimate)


def _match(T_cw: np.ndarray, landmarks: Landmarks, frame: FrameFeatures, limits: SearchLimits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    feature, is_visible = guided_matching.search(T_cw, landmarks, frame, limits)
    landmark = np.flatnonzero(feature >= 0)
    return landmark, feature[landmark], is_visible


def refine(T_cw: np.ndarray, x_w: np.ndarray, frame: FrameFeatures, feature: np.ndarray) -> PoseEstimate:
    """Refine a frame's pose on landmarks `x_w` (M, 3) [m, world] seen as its features `feature` (M,)."""
    measured = Measurements(frame.xy, frame.depth, frame.sigma_px, frame.sigma_z).take(feature)
    return camera_pose.refine_pose(T_cw, x_w, measured, frame.camera)


def search_limits(settings: TrackConfig) -> SearchLimits:
    """Return the limits of a search from a pose that tracking predicts."""
    return SearchLimits(settings.search_radius_px, settings.search_max_distance, settings.search_ratio)
