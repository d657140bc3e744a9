"""Films: the eye goes where it should, and what is written is a film."""

from pathlib import Path

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.visualization import video
from slamcli.visualization.render import Viewpoint

VIEW = Viewpoint(width=64, height=48)


def test_a_turn_goes_round_the_middle_at_one_distance() -> None:
    xyz = np.random.default_rng(0).uniform([-1, 0, 0], [3, 2, 1], (3000, 3))
    eyes = list(video.round_the_scene(xyz, VIEW, 12))
    away = np.array([eye.centre_l - [1.0, 1.0, 0.5] for eye in eyes])
    assert np.ptp(np.linalg.norm(away, axis=1)) < 0.03
    turn = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    assert np.degrees(np.diff(turn)) == pytest.approx([30.0] * 11, abs=1.0)
    for eye, there in zip(eyes, away, strict=True):
        assert eye.R_cl[2] @ there / np.linalg.norm(there) < -0.999, "it looks at the middle"
        pixel = eye.see(xyz)
        assert ((pixel[:, :2] >= 0) & (pixel[:, :2] < [eye.width, eye.height])).all(axis=1).mean() > 0.98


def test_the_way_is_followed_smoothly_past_lost_frames() -> None:
    n, rng = 90, np.random.default_rng(1)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = np.linspace(0.0, 3.0, n)
    shaken = T @ se3.exp(rng.normal(0, 0.01, (n, 6)))
    shaken[40:45] = np.nan
    eyes = list(video.along_the_way(shaken, VIEW, n))
    centre = np.array([eye.centre_l for eye in eyes])
    assert len(eyes) == n and np.abs(centre[20:-20, 2] + video.BEHIND).max() < 0.02
    assert np.abs(np.diff(centre[20:-20], 2, axis=0)).max() < 0.3 * np.nanmax(np.abs(np.diff(shaken[20:-20, :3, 3], 2, axis=0)))
    for eye in eyes:
        np.testing.assert_allclose(eye.R_cl @ eye.R_cl.T, np.eye(3), atol=1e-12)
    with pytest.raises(SlamError, match="no frame has a pose"):
        next(video.along_the_way(np.full((3, 4, 4), np.nan), VIEW, 3))


def test_a_film_is_read_back(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    shades = [20, 120, 220]
    for name in ("a.mp4", "b.mp4"):
        video.write_video(tmp_path / name, (np.full((48, 64, 3), shade, np.uint8) for shade in shades))
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    with av.open(tmp_path / "a.mp4") as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 3
    assert [frame.mean() for frame in frames] == pytest.approx(shades, abs=4)
