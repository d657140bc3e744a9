"""Motions: closed rounds of a robot, and trajectories recorded elsewhere."""

import numpy as np
import pytest

from slamcli.datasets.simulated import drive
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.schema import Trajectory

LOW, HIGH = np.zeros(3), np.array([8.0, 5.0, 2.6])


def rounds(seed: int = 0, **changes: object) -> drive.Motion:
    rng = np.random.default_rng(seed)
    pace = drive.Pace(**{"frames": 300, "speed": 0.6, "turn_rate": 0.8, "rate": 15.0, "laps": 1.1, **changes})
    return drive.rounds(drive.closed_path(LOW, HIGH, 1.35, rng), pace, height=0.75, pitch=-0.2, rng=rng)


@pytest.mark.parametrize("seed", range(5))
def test_path_is_closed_even_and_keeps_its_distance_from_the_walls(seed: int) -> None:
    path = drive.closed_path(LOW, HIGH, 1.35, np.random.default_rng(seed))
    step = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
    assert step.max() < 1.3 * step.min()
    assert (path > LOW[:2] + 1.2).all() and (path < HIGH[:2] - 1.2).all()
    assert 8.0 < step.sum() < 16.0


@pytest.mark.parametrize("seed", range(5))
def test_motion_is_smooth_and_comes_back(seed: int) -> None:
    T_lc = rounds(seed).colour_T_lc
    step = np.linalg.norm(se3.log(se3.inverse(T_lc[:-1]) @ T_lc[1:])[:, :3], axis=1)
    turn = np.linalg.norm(se3.log(se3.inverse(T_lc[:-1]) @ T_lc[1:])[:, 3:], axis=1)
    assert step.max() < 0.08 and np.degrees(turn.max()) < 4.0
    distance = np.linalg.norm(T_lc[270:, None, :3, 3] - T_lc[None, :30, :3, 3], axis=2).min(axis=1)
    assert distance.max() < 0.3  # the last tenth is driven over the first


def test_camera_looks_ahead_and_down_with_its_top_up() -> None:
    T_lc = rounds().colour_T_lc
    np.testing.assert_allclose(T_lc[:, :3, :3] @ np.swapaxes(T_lc[:, :3, :3], 1, 2), np.tile(np.eye(3), (300, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(T_lc[:, :3, :3]), 1.0)
    np.testing.assert_allclose(T_lc[:, 2, 3], 0.75, atol=0.02)
    np.testing.assert_allclose(np.arcsin(T_lc[:, 2, 2]), -0.2, atol=0.03)
    assert (T_lc[:, 2, 1] < -0.9).all()  # the camera's y axis points down
    forward = np.diff(T_lc[:, :2, 3], axis=0)
    assert np.median((forward * T_lc[:-1, :2, 2]).sum(axis=1) / np.linalg.norm(forward, axis=1)) > 0.95


def test_speed_and_turn_rate_are_bounds() -> None:
    motion = rounds(frames=None, speed=0.15, turn_rate=0.15, laps=1.0)
    T_lc, seconds = motion.colour_T_lc, np.diff(motion.colour_stamp)
    speed = np.linalg.norm(np.diff(T_lc[:, :2, 3], axis=0), axis=1) / seconds
    heading = np.unwrap(np.arctan2(T_lc[:, 1, 2], T_lc[:, 0, 2]))
    assert speed.max() < 0.15 * 1.15 and np.median(speed) > 0.08
    assert np.percentile(np.abs(np.diff(heading)) / seconds, 95) < 0.15 * 1.4
    assert 900 < len(T_lc) < 2500


def test_recorded_motion_is_interpolated_at_both_clocks() -> None:
    xi = np.array([0.3, 0.0, 0.1, 0.0, 0.2, 0.1])
    stamp = np.arange(5.0)
    trajectory = Trajectory(stamp=stamp, T_wc=se3.exp(stamp[:, None] * xi))
    motion = drive.along(trajectory, np.array([[0.25, 0.3], [3.9, 4.0], [3.95, 4.1]]), rate=15, frames=None)
    np.testing.assert_allclose(motion.colour_T_lc, se3.exp(np.array([[0.25], [3.9]]) * xi), atol=1e-9)
    np.testing.assert_allclose(motion.depth_T_lc, se3.exp(np.array([[0.3], [4.0]]) * xi), atol=1e-9)
    assert len(drive.along(trajectory, None, rate=10, frames=7).colour_stamp) == 7
    with pytest.raises(SlamError, match="no stamp lies within"):
        drive.along(trajectory, np.array([[9.0, 9.0]]), rate=10, frames=None)


def test_a_trajectory_of_one_pose_stands_still() -> None:
    trajectory = Trajectory(stamp=np.array([1.0]), T_wc=np.eye(4)[None])
    assert drive.interpolate(trajectory, np.array([1.0])).shape == (1, 4, 4)


def test_a_rest_is_one_pose_half_way_on_the_same_drive() -> None:
    plain, paused = rounds(3).colour_T_lc, rounds(3, frames=300 + 60, rest=4.0).colour_T_lc
    step = np.linalg.norm(np.diff(paused[:, :3, 3], axis=0), axis=1)
    still = np.flatnonzero(step == 0.0)
    assert 58 <= len(still) <= 61 and (np.diff(still) == 1).all() and abs(still.mean() - 179) < 1
    assert step.max() < 0.08
    np.testing.assert_allclose(paused[[0, -1]], plain[[0, -1]], atol=1e-9)


def test_without_a_number_of_frames_a_rest_adds_its_own() -> None:
    drive_on = {"frames": None, "speed": 0.4, "turn_rate": 0.6}
    assert len(rounds(1, rest=2.0, **drive_on).colour_stamp) == len(rounds(1, **drive_on).colour_stamp) + 30
