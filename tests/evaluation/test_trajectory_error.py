"""Errors against the truth: evo's command line is the oracle, and the metrics obey their laws."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from finished import disturb, wander

from slamcli.errors import SlamError
from slamcli.evaluation import trajectory_error
from slamcli.evaluation.trajectory_error import Ape
from slamcli.formats.trajectory import read_tum, write_tum
from slamcli.geometry import se3
from slamcli.schema import Trajectory


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(8)


@pytest.fixture
def recording(rng: np.random.Generator) -> tuple[Trajectory, Trajectory]:
    """Truth at 100 Hz and an estimate at 30 Hz from another origin, with stamps of their own, as in the TUM benchmark."""
    start = 1305031102.0
    fine = wander(rng, start + np.arange(0.0, 12.0, 0.01) + rng.uniform(-1e-3, 1e-3, 1200))
    frames = start + 0.3 + np.arange(300) / 30.0 + rng.uniform(-3e-3, 3e-3, 300)
    rows = np.abs(fine.stamp[:, None] - frames).argmin(axis=0)
    T_ow = se3.exp(rng.normal(0, 1, 6))
    estimate = disturb(rng, Trajectory(stamp=frames, T_wc=T_ow @ fine.T_wc[rows]), metres=0.02, radians=0.01)
    return estimate, fine


def evo_command(tool: str, folder: Path, estimate: Trajectory, truth: Trajectory, *options: str) -> tuple[dict, np.ndarray]:
    """Run evo's own command line on files; give its statistics and its errors."""
    write_tum(folder / "estimate.txt", estimate)
    write_tum(folder / "truth.txt", truth)
    command = [str(Path(sys.executable).with_name(tool)), "tum", "truth.txt", "estimate.txt", *options, "--save_results", "result.zip"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, env={**os.environ, "HOME": str(folder)}, timeout=120)
    with zipfile.ZipFile(folder / "result.zip") as archive, archive.open("error_array.npy") as errors:
        return json.loads(archive.read("stats.json")), np.load(errors)


def test_ape_is_that_of_evos_command_line(tmp_path: Path, recording: tuple[Trajectory, Trajectory]) -> None:
    estimate, truth = recording
    stats, errors = evo_command("evo_ape", tmp_path, estimate, truth, "-a", "--t_max_diff", "0.02")
    same_files = read_tum(tmp_path / "estimate.txt"), read_tum(tmp_path / "truth.txt")
    result = trajectory_error.ape(*same_files, n_frames=300, name="a")
    np.testing.assert_allclose(result.error, errors, rtol=0, atol=1e-9)
    for key in ("rmse", "mean", "median", "std", "min", "max"):
        assert result.to_dict()[key] == pytest.approx(stats[key], abs=1e-9)
    assert trajectory_error.ape(estimate, truth, n_frames=300, name="a").to_dict()["rmse"] == pytest.approx(stats["rmse"], abs=1e-9)
    assert 0.02 < result.to_dict()["rmse"] < 0.05  # three axes of 0.02 m give 0.035 m


def test_scaled_ape_is_that_of_evos_command_line(tmp_path: Path, recording: tuple[Trajectory, Trajectory]) -> None:
    estimate, truth = recording
    T_wc = estimate.T_wc.copy()
    T_wc[:, :3, 3] /= 1.04
    estimate = Trajectory(stamp=estimate.stamp, T_wc=T_wc)
    stats, _ = evo_command("evo_ape", tmp_path, estimate, truth, "-as", "--t_max_diff", "0.02")
    result = trajectory_error.ape(read_tum(tmp_path / "estimate.txt"), read_tum(tmp_path / "truth.txt"), n_frames=300, name="a")
    assert result.rmse_scaled == pytest.approx(stats["rmse"], abs=1e-9)
    assert result.scale == pytest.approx(1.04, abs=0.01)
    assert result.rmse_scaled < result.to_dict()["rmse"]


def test_rpe_per_frame_is_that_of_evos_command_line(tmp_path: Path, recording: tuple[Trajectory, Trajectory]) -> None:
    estimate, truth = recording
    for relation, column in (("trans_part", "translation"), ("angle_deg", "rotation_deg")):
        folder = tmp_path / relation
        folder.mkdir()
        options = ("--delta", "1", "--delta_unit", "f", "--all_pairs", "--t_max_diff", "0.02", "-r", relation)
        _, errors = evo_command("evo_rpe", folder, estimate, truth, *options)
        result = trajectory_error.rpe(
            read_tum(folder / "estimate.txt"), read_tum(folder / "truth.txt"), frame_stamp=estimate.stamp, name="a", seconds=None
        )
        np.testing.assert_allclose(getattr(result, column), errors, rtol=0, atol=1e-6 if column == "rotation_deg" else 1e-9)


def test_ape_does_not_depend_on_the_origin_and_grows_with_the_noise(
    rng: np.random.Generator, recording: tuple[Trajectory, Trajectory]
) -> None:
    estimate, truth = recording
    here = trajectory_error.ape(estimate, truth, n_frames=300, name="a")
    moved = Trajectory(stamp=estimate.stamp, T_wc=se3.exp(np.array([3.0, -2.0, 9.0, 1.0, 2.0, -0.4])) @ estimate.T_wc)
    there = trajectory_error.ape(moved, truth, n_frames=300, name="a")
    np.testing.assert_allclose(here.error, there.error, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(here.x_aligned - here.x_truth, axis=1), here.error, atol=1e-9)
    noisier = trajectory_error.ape(disturb(rng, estimate, metres=0.05, radians=0.0), truth, n_frames=300, name="a")
    assert noisier.to_dict()["rmse"] > 1.5 * here.to_dict()["rmse"]


def test_perfect_trajectory_has_no_error(recording: tuple[Trajectory, Trajectory]) -> None:
    truth = recording[1]
    result = trajectory_error.ape(truth, truth, n_frames=len(truth.stamp), name="a")
    assert result.to_dict()["max"] < 1e-9
    assert result.coverage == 1.0 and result.scale == pytest.approx(1.0, abs=1e-12)
    assert trajectory_error.rpe(truth, truth, frame_stamp=truth.stamp, name="a").to_dict()["max"] < 1e-9


def test_lost_frames_count_in_coverage_and_are_not_spanned(recording: tuple[Trajectory, Trajectory]) -> None:
    estimate, truth = recording
    keep = np.ones(300, dtype=bool)
    keep[100:140] = False
    part = Trajectory(stamp=estimate.stamp[keep], T_wc=estimate.T_wc[keep])
    figures = trajectory_error.ape(part, truth, n_frames=300, name="a").to_dict()
    assert (figures["n_poses"], figures["n_frames"], figures["lost"]) == (260, 300, 40)
    assert figures["coverage"] == pytest.approx(260 / 300)
    per_frame = trajectory_error.rpe(part, truth, frame_stamp=estimate.stamp, name="a", seconds=None)
    assert len(per_frame.stamp) == 258  # 260 poses in two pieces
    assert per_frame.to_dict()["max"] < 0.2


def test_rpe_over_a_second_pairs_by_time(recording: tuple[Trajectory, Trajectory]) -> None:
    estimate, truth = recording
    result = trajectory_error.rpe(estimate, truth, frame_stamp=estimate.stamp, name="a")
    assert 270 <= len(result.stamp) <= 273  # all but the last second of 10 s at 30 Hz, to within a tenth of it
    assert np.all(result.stamp >= estimate.stamp[0] + 0.9)
    drift = Trajectory(stamp=estimate.stamp, T_wc=estimate.T_wc.copy())
    drift.T_wc[:, :3, 3] += (0.5 * (estimate.stamp - estimate.stamp[0]))[:, None] * [1.0, 0.0, 0.0]
    drifting = trajectory_error.rpe(drift, truth, frame_stamp=estimate.stamp, name="a")
    assert drifting.to_dict()["median"] == pytest.approx(0.5, abs=0.05)


def test_too_little_to_compare_is_said() -> None:
    truth = wander(np.random.default_rng(0), np.arange(100.0))
    few = Trajectory(stamp=truth.stamp[:2], T_wc=truth.T_wc[:2])
    with pytest.raises(SlamError, match="2 poses are too few"):
        trajectory_error.ape(few, truth, n_frames=2, name="a")
    other_clock = Trajectory(stamp=truth.stamp * 1e9 + 1e18, T_wc=truth.T_wc)
    with pytest.raises(SlamError, match="same clock"):
        trajectory_error.ape(other_clock, truth, n_frames=100, name="a")
    line = Trajectory(stamp=truth.stamp, T_wc=np.tile(np.eye(4), (100, 1, 1)))
    line.T_wc[:, 0, 3] = np.arange(100.0)
    with pytest.raises(SlamError, match="one line"):
        trajectory_error.ape(line, line, n_frames=100, name="a")
    short = Trajectory(stamp=truth.stamp[:10] / 100, T_wc=truth.T_wc[:10])
    with pytest.raises(SlamError, match="no two poses to compare over 1 s"):
        trajectory_error.rpe(short, short, frame_stamp=short.stamp, name="a")


def test_the_error_prints_in_one_line_and_knows_its_rmse() -> None:
    error = np.array([0.003, 0.004])
    ape = Ape("room", "loop", 2, 2, np.arange(2.0), error, np.zeros((2, 3)), np.zeros((2, 3)), np.eye(4), 1.0, 0.0035)
    assert ape.rmse == pytest.approx(np.sqrt(12.5) * 1e-3)
    assert "name='room'" in repr(ape) and "array" not in repr(ape)
