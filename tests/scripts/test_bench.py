"""The figures of README and docs are those of the committed measurement, and a stage that has become slower is told of."""

import copy
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from recordings import write_recording

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import bench  # noqa: E402
import ledger  # noqa: E402

from slamcli.datasets import open_dataset  # noqa: E402
from slamcli.errors import SlamError  # noqa: E402

FIGURES = ROOT / "scripts" / "figures.json"


@pytest.fixture
def measured() -> list[dict]:
    return json.loads(FIGURES.read_text())


def test_readme_and_docs_hold_the_tables_of_the_committed_measurement(measured: list[dict]) -> None:
    for page, text in ((ROOT / "README.md", bench.summary_table(measured)), (ROOT / "docs" / "figures.md", bench.tables(measured))):
        assert f"{bench.MARKS[0]}\n{text}\n{bench.MARKS[1]}" in page.read_text()


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


def records(*stages: tuple[str, float, float, float]) -> list[dict]:
    return [{"stage": name, "cpu_seconds": cpu, "seconds": wall, "compile_seconds": compiling} for name, cpu, wall, compiling in stages]


def test_the_ledger_leaves_compiling_out_and_tells_shares_and_multiples() -> None:
    costs = ledger.stage_costs(records(("extract", 3.0, 2.0, 1.0), ("track", 0.5, 0.5, 0.0)), 100)
    assert costs == {"extract": {"cpu_ms": 20.0, "wall_ms": 10.0}, "track": {"cpu_ms": 5.0, "wall_ms": 5.0}}
    found = ledger.rows(costs, plain_orb_ms=5.0, orbslam3_ms=50.0)
    assert found[0] == ["extract", "20.00", "10.00", "100 %", "4.00", "0.40"]
    assert found[-1] == ["all", "25.00", "15.00", "83 %", "5.00", "0.50"]
    assert all(row[-1] == "" for row in ledger.rows(costs, plain_orb_ms=5.0))
    assert all(len(row) == 1 + len(ledger.HEADINGS) for row in found)


def test_of_rounds_each_figure_is_the_median() -> None:
    rounds = [ledger.stage_costs(records(("track", cpu, wall, 0.0)), 1000) for cpu, wall in ((1.0, 9.0), (5.0, 2.0), (2.0, 3.0))]
    assert ledger.middle(rounds) == {"track": {"cpu_ms": 2.0, "wall_ms": 3.0}}


def test_a_recording_is_rewritten_as_png_of_the_same_pixels(tmp_path: Path) -> None:
    source = write_recording(tmp_path / "jpg", suffix=".jpg")
    (made := tmp_path / "png").parent.mkdir(exist_ok=True)
    ours, theirs = open_dataset(str(ledger.as_png(str(source), made))), open_dataset(str(source))
    assert len(ours) == len(theirs) == 4
    for i in range(4):
        np.testing.assert_array_equal(ours.rgb(i), theirs.rgb(i))
        np.testing.assert_array_equal(ours.depth(i), theirs.depth(i))
    assert all(path.suffix == ".png" for path in (made / "png").iterdir())


def test_without_the_profiler_the_way_to_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SlamError, match="pip install py-spy"):
        ledger.flame("demo", tmp_path / "graph.svg", tmp_path / "run")
