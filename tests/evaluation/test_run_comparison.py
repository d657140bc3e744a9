"""Runs compared: what differs is told with its size, and what is the same byte for byte as such."""

import json
import shutil
from dataclasses import replace

import finished
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.config import toml
from slamcli.evaluation import run_comparison
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Grid


def a_grid(seed: int = 0) -> Grid:
    state = np.random.default_rng(seed).integers(-1, 2, (30, 40)).astype(np.int8)
    return Grid(np.zeros((30, 40), np.float32), np.ones((30, 40), np.int32), state, origin=np.array([-1.0, 0.5]), resolution=np.array(0.05))


@given(st.integers(0, 5), st.integers(0, 60))
def test_cells_flipped_are_counted_one_by_one(seed: int, n: int) -> None:
    grid = a_grid(seed)
    known = np.argwhere(grid.state >= 0)[:n]
    state = grid.state.copy()
    state[known[:, 0], known[:, 1]] = 1 - state[known[:, 0], known[:, 1]]
    flipped, share = run_comparison.grid_difference(replace(grid, state=state), grid)
    assert flipped == pytest.approx(n / (grid.state >= 0).sum())
    assert share == 1.0


def test_grids_are_laid_over_each_other_by_their_origins() -> None:
    grid = a_grid()
    moved = replace(grid, state=grid.state[5:, 3:], origin=grid.origin + np.array([3, 5]) * 0.05)
    flipped, share = run_comparison.grid_difference(moved, grid)
    assert flipped == 0.0
    assert share == pytest.approx((grid.state[5:, 3:] >= 0).sum() / (grid.state >= 0).sum())
    assert run_comparison.grid_difference(replace(grid, origin=grid.origin + 99.0), grid) == (None, 0.0)
    assert run_comparison.grid_difference(replace(grid, resolution=np.array(0.1)), grid) == (None, None)


def test_the_distance_of_two_clouds_is_that_to_the_nearest_point() -> None:
    plane = np.stack(np.meshgrid(np.arange(60), np.arange(60), [0]), axis=-1).reshape(-1, 3) * 0.1
    median, p95 = run_comparison.cloud_distance(plane + [0, 0, 0.02], plane)
    assert (median, p95) == pytest.approx((0.02, 0.02))
    assert run_comparison.cloud_distance(plane, np.zeros((0, 3))) == (None, None)


def test_only_options_that_differ_are_told() -> None:
    a, b = {"track.x": 1, "seed": 0}, {"track.x": 2, "seed": 0}
    assert run_comparison.differing_settings([a, b]) == [{"track.x": 1}, {"track.x": 2}]
    assert run_comparison.differing_settings([a, {**a, "camera.fx": 500.0}]) == [{"camera.fx": None}, {"camera.fx": 500.0}]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple:
    first = finished.make(tmp_path_factory.mktemp("a"), frames=40, n_lost=3)
    second = finished.make(tmp_path_factory.mktemp("b"), frames=40, n_lost=5, seed=1)
    return first.run, second.run


def test_compare_on_the_command_line(slamcli, pair, tmp_path) -> None:
    run, other = pair
    shutil.copytree(run, tmp_path / "same")
    same = RunDir.find(str(tmp_path / "same"))
    same.write_config(toml.apply(same.config(), ["track.min_inliers=20"]))
    compared = json.loads(slamcli("compare", run, tmp_path / "same", other, "--json").stdout)
    assert [one["located"] for one in compared] == [37, 37, 35]
    assert compared[1]["settings"] == {"track.min_inliers": 20}
    assert "loop" in compared[1]["same_output"] and "loop" not in compared[2]["same_output"]
    assert compared[1]["difference"]["cloud_median"] == 0.0 and compared[2]["difference"]["cloud_median"] > 0.0
    assert compared[0]["difference"] is None
    assert 0.006 < compared[0]["ape"] < 0.011
    table = slamcli("compare", run, other, "-o", tmp_path / "page.html").stdout
    assert "37 of 40" in table and "APE RMSE [mm]" in table
    page = (tmp_path / "page.html").read_text()
    assert "37 of 40" in page
    assert "http:" not in page and "https:" not in page


def test_compare_says_what_is_wrong(slamcli, pair, tmp_path) -> None:
    assert slamcli("compare", pair[0]).exit_code == 2
    assert "not a run directory" in slamcli("compare", pair[0], tmp_path / "none").stderr
    assert "must end in .html" in slamcli("compare", *pair, "-o", tmp_path / "page.pdf").stderr
    assert RunDir.find(str(pair[0])).record("loop") is not None
