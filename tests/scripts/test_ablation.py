"""The page's table of levers is that of the committed measurement, and a gain is what a lever takes off the error."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import ablation  # noqa: E402
import accuracy  # noqa: E402

from slamcli.config import toml  # noqa: E402
from slamcli.config.options import Config  # noqa: E402

ON, OFF = "optimize.readout=false", "optimize.intrinsics=true"


def pair(lever: str, default: float, turned: float, **of) -> dict:
    told = {"recording": "room", "is_simulated": False, "offset": 0, "seed": 0, "lever": lever} | of
    return told | {"default": {"ape": default, "coverage": 1.0}, "turned": {"ape": turned, "coverage": 1.0}}


def test_the_page_holds_the_table_of_the_committed_measurement() -> None:
    pairs = json.loads((ROOT / "scripts" / "ablation.json").read_text())
    page = (ROOT / "docs" / "accuracy.md").read_text()
    assert f"{ablation.MARKS[0]}\n{ablation.table(pairs)}\n{ablation.MARKS[1]}" in page


@pytest.mark.parametrize("lever", ablation.LEVERS)
def test_turning_a_lever_changes_the_default(lever: str) -> None:
    changed = toml.apply(Config(), [lever])
    assert changed != Config()
    if ablation.is_on(lever):
        section, option = lever.partition("=")[0].split(".")
        assert getattr(getattr(Config(), section), option)


def test_a_gain_is_what_having_the_lever_on_takes_off_the_error() -> None:
    helpful = [pair(ON, 0.005, 0.007), pair(ON, 0.005, 0.006), pair(ON, 0.005, 0.0045)]  # on by default: without it the error is larger
    assert ablation.gain_cells(ON, helpful) == ["+1.00 (-0.50 to +2.00)", "2 / 1 of 3"]
    assert ablation.gain_cells(OFF, [pair(OFF, 0.005, 0.007)]) == ["-2.00 (-2.00 to -2.00)", "0 / 1 of 1"]
    assert ablation.gain_cells(ON, [pair(ON, 0.005, 0.00501)])[1] == "0 / 0 of 1"
    assert ablation.gain_cells(ON, []) == ["", ""]


def test_real_and_simulated_recordings_are_told_apart() -> None:
    row = ablation.table([pair(ON, 0.005, 0.006), pair(ON, 0.005, 0.004, is_simulated=True)]).splitlines()[-1]
    assert row.index("+1.00") < row.index("-1.00") and "| on |" in row


def test_a_pair_measured_again_replaces_the_one_before_and_no_other() -> None:
    before = [pair(ON, 0.005, 0.006), pair(OFF, 0.005, 0.006), pair(ON, 0.005, 0.006, seed=1)]
    after = ablation.merged(before, [pair(ON, 0.004, 0.007)])
    assert after == [pair(ON, 0.004, 0.007), *before[1:]]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("optimize.readout=false", accuracy.CHAIN[3:]),
        ("track.min_inliers=16", accuracy.CHAIN[2:]),
        ("match.ratio=0.7", accuracy.CHAIN[1:]),
        ("camera.fx=500", accuracy.CHAIN),
        ("seed=7", accuracy.STAGES),  # features are the same for every seed
        ("octree.hit=0.8", ()),
    ],
)
def test_only_what_a_change_concerns_runs_again(change: str, expected: tuple) -> None:
    run = SimpleNamespace(record=lambda name: {})
    assert accuracy.to_run(run, Config(), toml.apply(Config(), [change])) == tuple(expected)


def test_a_stage_that_is_not_there_runs_with_all_after_it() -> None:
    run = SimpleNamespace(record=lambda name: None if name == "optimize" else {})
    assert accuracy.to_run(run, Config(), Config()) == ("optimize", "loop")
