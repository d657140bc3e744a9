"""A pose from few landmarks meets the background's motion: drawn towards it, or dropped where the two contradict each other."""

import numpy as np
import pytest

from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.geometry import se3
from slamcli.slam.background_prior import BETWEEN_FRAMES, reconcile
from slamcli.slam.local_map import MapMatch

POSE = se3.exp(np.array([0.3, -0.1, 0.5, 0.2, 0.1, -0.3]))


def match(T_cw: np.ndarray, information: np.ndarray) -> MapMatch:
    estimate = PoseEstimate(T_cw, np.ones(30, bool), 30, information, rms=0.5)
    return MapMatch(estimate, np.zeros(30, np.int32))


@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_the_pose_lies_between_the_two_as_their_informations_say(weight: float) -> None:
    away = np.array([0.004, -0.002, 0.001, 0.0, 0.002, 0.001])
    found = reconcile(match(POSE, weight * BETWEEN_FRAMES), se3.exp(away) @ POSE)
    assert found is not None
    np.testing.assert_allclose(se3.log(found.estimate.T_cw @ se3.inverse(POSE)), away / (1.0 + weight), atol=1e-9)
    np.testing.assert_allclose(found.estimate.information, (1.0 + weight) * BETWEEN_FRAMES)


def test_landmarks_that_contradict_the_background_are_somebody_elses() -> None:
    expected = se3.exp(np.array([0.04, 0.0, 0.0, 0.0, 0.0, 0.0])) @ POSE
    assert reconcile(match(POSE, 10.0 * BETWEEN_FRAMES), expected) is None
    assert reconcile(match(POSE, 1e-3 * BETWEEN_FRAMES), expected) is not None  # landmarks that hardly know contradict nothing
