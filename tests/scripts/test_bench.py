"""The README's figures are those of the committed measurement, and a stage that has become slower is told of."""

import copy
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import bench  # noqa: E402

from slamcli.errors import SlamError  # noqa: E402

FIGURES = ROOT / "scripts" / "figures.json"


@pytest.fixture
def measured() -> list[dict]:
    return json.loads(FIGURES.read_text())


def test_the_readme_holds_the_tables_of_the_committed_measurement(measured: list[dict]) -> None:
    readme = (ROOT / "README.md").read_text()
    assert f"{bench.MARKS[0]}\n{bench.tables(measured)}\n{bench.MARKS[1]}" in readme


def test_published_measured_and_simulated_figures_are_told_apart(measured: list[dict]) -> None:
    for line in bench.ape_table(measured).splitlines()[:1]:
        cells = [cell.strip() for cell in line.strip("|").split("|")][1:]
        assert all(cell.endswith("measured here") != ("published" in cell) for cell in cells)
    for figures in measured:
        assert ("(simulated)" in bench.name_of(figures)) == figures["is_simulated"]


def test_the_same_figures_are_no_slower_and_a_stage_that_grew_is_named(measured: list[dict]) -> None:
    assert bench.slower(measured, measured) == []
    now = copy.deepcopy(measured)
    now[0]["systems"]["slamcli"]["stages"]["track"] *= 1.3
    (told,) = bench.slower(now, measured)
    assert "track" in told and now[0]["recording"] in told


def test_a_slower_machine_is_no_slower_program(measured: list[dict]) -> None:
    now = copy.deepcopy(measured)
    for figures in now:
        figures["plain_orb_ms"] *= 2
        stages = figures["systems"]["slamcli"]["stages"]
        stages.update({stage: 2 * value for stage, value in stages.items()})
    assert bench.slower(now, measured) == []


def test_tables_go_between_the_marks_and_nowhere_else(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{bench.MARKS[0]}\nold\n{bench.MARKS[1]}\nafter\n")
    bench.put_into(page, "new")
    assert page.read_text() == f"before\n{bench.MARKS[0]}\nnew\n{bench.MARKS[1]}\nafter\n"
    page.write_text("no marks")
    with pytest.raises(SlamError, match="there is no"):
        bench.put_into(page, "new")
