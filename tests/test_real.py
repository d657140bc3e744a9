"""Whole runs on real recordings: TUM RGB-D under $SLAMCLI_DATA or ../shared/data, else skipped."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slamcli import artifacts
from slamcli.cli.main import cli
from slamcli.formats.grid_map import read as read_grid
from slamcli.schema import Ground, Timing

DATA = Path(os.environ.get("SLAMCLI_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="module", params=["freiburg1_xyz", "freiburg3_teddy"])
def real_run(request, tmp_path_factory):
    """Run every stage on a real recording; gives its name and the run directory."""
    recording = DATA / "tum" / f"rgbd_dataset_{request.param}"
    if not recording.is_dir():
        pytest.skip(f"no recording at {recording}: set SLAMCLI_DATA to the folder that holds tum/")
    path = tmp_path_factory.mktemp("real") / request.param
    result = CliRunner().invoke(cli, ["run", str(recording), "-r", str(path)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return request.param, path


def test_trajectory_is_within_the_figures_of_the_readme(real_run):
    name, path = real_run
    result = CliRunner().invoke(cli, ["eval", "ape", "-r", str(path), "--json"], catch_exceptions=False)
    ape = json.loads(result.stdout)
    assert ape["coverage"] >= 0.99 and ape["n_frames"] == {"freiburg1_xyz": 798, "freiburg3_teddy": 200}[name]
    assert 0.001 < ape["rmse"] < {"freiburg1_xyz": 0.007, "freiburg3_teddy": 0.006}[name]
    assert abs(ape["scale"] - 1.0) < 0.01


def test_both_cameras_roll_their_shutters_alike(real_run):
    _, path = real_run
    timing = artifacts.load(Timing, path / "optimize")
    assert 0.015 < float(timing.readout) < 0.025
    assert -0.03 < float(timing.depth_delay) < 0.005


def test_floor_and_grid(real_run):
    name, path = real_run
    ground = artifacts.load(Ground, path / "densify")
    assert bool(ground.is_found)
    height = float(ground.T_lw[2, 3])  # of the first camera, above the floor
    assert {"freiburg1_xyz": 1.0, "freiburg3_teddy": 0.5}[name] < height < 2.0
    assert np.isin([0, 1, -1], read_grid(path / "grid2d" / "map.yaml").state).all()


def test_octree_file_is_small_beside_the_cloud(real_run):
    _, path = real_run
    share = (path / "octree" / "map.bt").stat().st_size / (path / "densify" / "cloud.ply").stat().st_size
    assert 1e-4 < share < 0.032
