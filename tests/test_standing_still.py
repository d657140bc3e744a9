"""One view seen again and again with fresh noise, from the images to the trajectory: one pose, one key frame."""

from pathlib import Path

import numpy as np

import slamcli
from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate
from slamcli.datasets.simulated.drive import look_along
from slamcli.formats.trajectory import write_tum
from slamcli.geometry import se3
from slamcli.schema import Map, Trajectory

FRAMES = 36


def test_a_camera_at_rest_has_one_pose_and_one_key_frame(tmp_path: Path) -> None:
    T_gc = np.repeat(look_along(np.array([[1.0, 1.0, 0.8]]), np.array([0.3]), -0.2, 0.0), FRAMES + 1, axis=0)
    write_tum(tmp_path / "path.txt", Trajectory(np.arange(FRAMES + 1) / 15.0, T_gc))
    recording = simulate(
        tmp_path / "still", progress=silent, trajectory=tmp_path / "path.txt", frames=FRAMES, width=320, height=240, seed=5
    )
    run = slamcli.run(recording, path=tmp_path / "run", until="loop")
    T_wc = run.trajectory("loop").T_wc
    assert len(T_wc) == FRAMES
    apart = se3.log(se3.inverse(T_wc[0]) @ T_wc)
    assert np.linalg.norm(apart[:, :3], axis=1).max() <= 3e-4 and np.degrees(np.linalg.norm(apart[:, 3:], axis=1)).max() <= 0.03
    assert run.directory.load(Map, "loop").kf_frame.tolist() == [0]
    assert run.summary()["track"]["at_rest"] == FRAMES - 1
