"""Every stage of the table keeps the contract."""

import importlib
import inspect

import pytest

from slamcli.stages import STAGES
from slamcli.stages.contract import StageFunction


@pytest.mark.parametrize("name", [stage.name for stage in STAGES])
def test_a_stage_is_a_function_run_of_the_contracts_arguments(name: str) -> None:
    run = importlib.import_module(f"slamcli.stages.{name}").run
    wanted = inspect.signature(StageFunction.__call__, eval_str=True)
    given = inspect.signature(run, eval_str=True)
    assert list(given.parameters.values()) == list(wanted.parameters.values())[1:]
    assert given.return_annotation == wanted.return_annotation
