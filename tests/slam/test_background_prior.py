"""A pose from few landmarks meets the background's motion: drawn towards it, or dropped where the two contradict each other."""

import numpy as np
import pytest

from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.geometry import se3
from slamcli.slam.background_prior import APART_M, APART_SHARE, BETWEEN_FRAMES, CONTRADICTS_CHI2, ENOUGH, MANY, contradicts, drawn
from slamcli.slam.local_map import MapMatch

POSE = se3.exp(np.array([0.3, -0.1, 0.5, 0.2, 0.1, -0.3]))


SURE = 1e9 * np.eye(6)


def match(T_cw: np.ndarray, information: np.ndarray, n: int = 30) -> MapMatch:
    estimate = PoseEstimate(T_cw, np.ones(n, bool), n, information, rms=0.5)
    return MapMatch(estimate, np.zeros(n, np.int32))


@pytest.mark.parametrize("weight", [0.1, 1.0, 10.0])
def test_the_pose_lies_between_the_two_as_their_informations_say(weight: float) -> None:
    away = np.array([0.004, -0.002, 0.001, 0.0, 0.002, 0.001])
    found = drawn(match(POSE, weight * BETWEEN_FRAMES), se3.exp(away) @ POSE)
    np.testing.assert_allclose(se3.log(found.estimate.T_cw @ se3.inverse(POSE)), away / (1.0 + weight), atol=1e-9)
    np.testing.assert_allclose(found.estimate.information, (1.0 + weight) * BETWEEN_FRAMES)


@pytest.mark.parametrize(("n", "is_drawn"), [(ENOUGH - 1, True), (ENOUGH, False)])
def test_landmarks_enough_hold_a_pose_by_themselves(n: int, is_drawn: bool) -> None:
    expected = se3.exp(np.array([0.004, 0.0, 0.0, 0.0, 0.0, 0.0])) @ POSE
    found = drawn(match(POSE, BETWEEN_FRAMES, n), expected)
    assert (found.estimate.T_cw != POSE).any() == is_drawn


@pytest.mark.parametrize("motion", [0.0, 0.1, 0.3])
@pytest.mark.parametrize(("times", "is_contradicted"), [(0.98, False), (1.02, True)])
def test_landmarks_that_contradict_the_background_are_somebody_elses(motion: float, times: float, is_contradicted: bool) -> None:
    """The limit is d^2 = CHI2 (APART_M^2 + SHARE^2 (motion^2 + d^2)), as the pose expected lies aside by d of where the camera moved."""
    earlier = se3.inverse(se3.exp(np.array([0.0, -motion, 0.0, 0.0, 0.0, 0.0])) @ POSE)
    limit = np.sqrt(CONTRADICTS_CHI2 * (APART_M**2 + (APART_SHARE * motion) ** 2) / (1.0 - CONTRADICTS_CHI2 * APART_SHARE**2))
    expected = se3.exp(np.array([times * limit, 0.0, 0.0, 0.0, 0.0, 0.0])) @ POSE
    assert contradicts(match(POSE, SURE), expected, earlier) == is_contradicted


@pytest.mark.parametrize(("n", "is_contradicted"), [(MANY - 1, True), (MANY, False)])
def test_many_landmarks_are_believed_against_the_background(n: int, is_contradicted: bool) -> None:
    expected = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])) @ POSE
    assert contradicts(match(POSE, SURE, n), expected, se3.inverse(POSE)) == is_contradicted


def test_landmarks_that_hardly_know_contradict_nothing() -> None:
    expected = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])) @ POSE
    assert contradicts(match(POSE, SURE), expected, se3.inverse(POSE)) and not contradicts(
        match(POSE, 40.0 * np.eye(6)), expected, se3.inverse(POSE)
    )
