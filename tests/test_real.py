"""Whole runs on real recordings: TUM RGB-D under $SLAMCLI_DATA or ../shared/data, else skipped."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slamcli import artifacts
from slamcli.cli.main import cli
from slamcli.formats.cloud import read_ply
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


def test_the_floor_is_the_lowest_surface_and_not_the_largest(real_run):
    name, path = real_run
    assert bool(artifacts.load(Ground, path / "densify").is_found)
    xyz = read_ply(path / "densify" / "cloud.ply")[0].astype(np.float64)
    floor = xyz[np.abs(xyz[:, 2]) < 0.05]
    slope = np.linalg.lstsq(np.column_stack([floor[:, :2], np.ones(len(floor))]), floor[:, 2], rcond=None)[0]
    assert len(floor) > 20000
    assert np.degrees(np.arctan(np.hypot(slope[0], slope[1]))) < 1.0 and abs(slope[2]) < 0.02
    assert np.mean(xyz[:, 2] < -0.1) < 0.02
    if name == "freiburg1_xyz":  # a desk fills most images
        desk = xyz[np.abs(xyz[:, 2] - 0.73) < 0.05]
        assert len(desk) > len(floor)


def test_the_grid_holds_what_stands_on_the_floor(real_run):
    name, path = real_run
    made = read_grid(path / "grid2d" / "map.yaml")
    assert np.isin([0, 1, -1], made.state).all()
    if name == "freiburg3_teddy":  # the box under the bear: two sides of it were seen, before the first camera
        column, row = np.floor((np.array([[0.6, -0.3], [1.3, 0.3]]) - made.origin) / made.resolution).astype(int).T
        box = made.state[row[0] : row[1], column[0] : column[1]]
        assert 15 <= np.count_nonzero(box == 1) <= 80
        assert np.count_nonzero(box == 0) == 0


def test_octree_file_is_small_beside_the_cloud(real_run):
    _, path = real_run
    share = (path / "octree" / "map.bt").stat().st_size / (path / "densify" / "cloud.ply").stat().st_size
    assert 1e-4 < share < 0.032
