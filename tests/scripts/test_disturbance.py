"""A covered lens and a cut recording: tracking goes on, nearly every frame that shows something has a pose, and accuracy stays."""

import numpy as np
import pytest
from scene_run import Run
from scenes import RATE, ape, observe, room_points, sweep

from slamcli.schema import frame_poses
from slamcli.stages import loop, optimize, track

BLACK = range(70, 100)  # 30 frames
CUT = range(60, 60 + int(3.0 * RATE))


def there_and_back(n: int) -> np.ndarray:
    """Move along a wall and back, so that what a gap hides on the way is seen on the way home."""
    there = sweep(n, length=1.6)
    return np.concatenate([there, there[::-1]])


def result(folder, *, cut=range(0), blind=range(0)):
    """Run the stages; returns the poses and the APE [m] of the frames that have one."""
    rng = np.random.default_rng(5)
    poses = np.delete(there_and_back(110), np.array(cut, dtype=int), axis=0)
    run = Run(observe(poses, room_points(5000, rng), rng, blind=blind), folder)
    for module in (track, optimize, loop):
        run.stage(module)
    T_wc = frame_poses(*run.result("loop"))
    return T_wc, ape(T_wc, poses)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    T_wc, error = result(tmp_path_factory.mktemp("undisturbed"))
    assert np.isfinite(T_wc).all() and error > 1e-4
    return error


def test_a_blackout_of_30_frames(undisturbed, tmp_path):
    T_wc, error = result(tmp_path, blind=BLACK)
    has_pose = np.isfinite(T_wc[:, 0, 0])
    visible = np.delete(np.arange(len(T_wc)), BLACK)
    assert not has_pose[list(BLACK)].any() and has_pose[visible].mean() >= 0.95
    assert 0.5 * undisturbed < error < 1.2 * undisturbed


def test_a_jump_of_three_seconds(undisturbed, tmp_path):
    T_wc, error = result(tmp_path, cut=CUT)
    assert np.isfinite(T_wc[:, 0, 0]).mean() >= 0.95
    assert 0.5 * undisturbed < error < 1.2 * undisturbed
