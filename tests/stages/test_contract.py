"""Every stage of the table keeps the contract."""

import importlib
import inspect
from pathlib import Path

import pytest

from slamcli.runs.run_directory import RunDir
from slamcli.stages import INTERMEDIATE, NAMES, STAGES
from slamcli.stages.contract import StageFunction
from slamcli.stages.joining import JOINS


@pytest.mark.parametrize("name", [stage.name for stage in STAGES])
def test_a_stage_is_a_function_run_of_the_contracts_arguments(name: str) -> None:
    run = importlib.import_module(f"slamcli.stages.{name}").run
    wanted = inspect.signature(StageFunction.__call__, eval_str=True)
    given = inspect.signature(run, eval_str=True)
    assert list(given.parameters.values()) == list(wanted.parameters.values())[1:]
    assert given.return_annotation == wanted.return_annotation


def test_every_stage_before_the_recordings_are_one_map_has_a_join() -> None:
    assert tuple(JOINS) == NAMES[: NAMES.index("loop")]


def test_no_result_is_taken_for_intermediate() -> None:
    """`clean` keeps what can be looked at; every stage that it deletes is read by a later one."""
    for name in INTERMEDIATE:
        assert any(name in stage.needs for stage in STAGES[NAMES.index(name) + 1 :])
        assert NAMES.index(name) < NAMES.index("loop"), "the final trajectory and all after it are results"


def test_what_is_told_of_a_stage_is_counted_in_its_summary(room_run: Path) -> None:
    run = RunDir(room_run)
    for stage in STAGES:
        assert stage.told
        assert set(stage.told) <= set((run.record(stage.name) or {})["summary"]), stage.name
