"""What messages advise can be done as it stands: commands and flags by the program's users, calls and arguments by those of Python."""

import ast
import contextlib
import importlib
import inspect
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import click
import pytest
from click.testing import Result
from test_layers import MODULES, parsed

import slamcli
from slamcli import api
from slamcli.cli.main import cli
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.hints import FLAGS, FLAGS_OF_OPTIONS, Hints, ShellHints, hint, run_flag, spoken

RUN = Path("runs/front room")
GIVEN = {"run": RUN, "recording": Path("rec/a b"), "stage": "track", "page": "p.html", "until": "loop"}
OTHERWISE = ("argument", "option", "setting")  # no whole step, but words within one
STEPS = sorted(name for name in vars(Hints) if not name.startswith("_") and name not in OTHERWISE)


def advised(hints: Hints, step: str) -> str:
    method = getattr(hints, step)
    return str(method(**{name: GIVEN[name] for name in inspect.signature(method).parameters}))


def flags_of(command: click.Command) -> set[str]:
    return {flag for one in command.params for flag in one.opts}


def every_flag(group: click.Group) -> set[str]:
    found = set()
    for command in group.commands.values():
        found |= every_flag(command) if isinstance(command, click.Group) else flags_of(command)
    return found


@pytest.mark.parametrize("step", STEPS)
def test_a_step_in_the_shell_is_a_command_with_flags_that_it_has(step: str) -> None:
    program, *words = shlex.split(advised(ShellHints(), step))
    assert program == "slamcli"
    command: click.Command = cli
    while isinstance(command, click.Group):
        command = command.commands[words.pop(0)]
    assert {word for word in words if word.startswith("-")} <= flags_of(command)
    wants_run = "run" in inspect.signature(getattr(ShellHints, step)).parameters
    assert (str(RUN) in words) == wants_run, "one word for the shell, whatever the folder is called"


@pytest.mark.parametrize("step", STEPS)
def test_a_step_in_python_names_what_there_is(step: str) -> None:
    said = advised(Hints(), step)
    dotted = re.findall(r"slamcli(?:\.\w+)+", said)
    for name in dotted:
        assert resolved(name) is not None
    for call, arguments in re.findall(r"\.(update|run_stage|add|report|ape|open_run|run)\(([^()]*)\)", said):
        takes = inspect.signature(getattr(api.Run, call, None) or getattr(slamcli, call)).parameters
        assert set(re.findall(r"(\w+)=", arguments)) <= set(takes)
    assert dotted or said.startswith("run.")


def resolved(name: str) -> object:
    """Return what a dotted name stands for; AttributeError where it stands for nothing."""
    found: object = slamcli
    for at, part in enumerate(parts := name.split(".")[1:], 2):
        if not hasattr(found, part) and inspect.ismodule(found):
            importlib.import_module(".".join(["slamcli", *parts[: at - 1]]))
        found = getattr(found, part)
    return found


def calls_of_hint(method: str) -> set[str]:
    """Return the texts that the library gives to a method of the hints."""
    return {
        str(node.args[0].value)
        for path in MODULES
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == f"hint().{method}" and isinstance(node.args[0], ast.Constant)
    }


def test_every_argument_that_a_message_names_has_a_flag_and_every_option_is_one() -> None:
    assert calls_of_hint("argument") == set(FLAGS)
    assert set(FLAGS.values()) | set(FLAGS_OF_OPTIONS.values()) <= every_flag(cli)
    named = calls_of_hint("option") | calls_of_hint("setting")
    assert set(FLAGS_OF_OPTIONS) <= named <= set(toml.known_keys())


def test_one_message_speaks_python_to_a_caller_in_python_and_the_shell_to_a_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slamcli: Callable[..., Result]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SlamError) as told:
        api.open_run("front room")
    assert str(told.value).endswith("make one with: slamcli.run(TARGET, path='runs/front room')")
    said = slamcli("status", "-r", "front room")
    assert said.exit_code == 1
    assert said.output.rstrip().endswith("make one with: slamcli run TARGET -r 'runs/front room'")
    assert type(hint()) is Hints, "a command leaves nothing behind in a process that goes on"


def test_hints_are_given_back_after_an_error() -> None:
    with contextlib.suppress(SlamError), spoken(ShellHints()):
        assert hint().update(RUN) == f"slamcli run {run_flag(RUN)}"
        raise SlamError("")
    assert hint().update(RUN) == "slamcli.open_run('runs/front room').update()"


@pytest.mark.parametrize(
    ("name", "value"), [("recording.find_depth_camera", False), ("camera.depth_scale", 1000.0), ("track.min_inliers", 20)]
)
def test_a_setting_can_be_given_as_it_is_advised(name: str, value: float) -> None:
    in_python = eval(f"dict({Hints().setting(name, value)})")["settings"]  # what the message says, and nothing else
    flag, assignment = shlex.split(ShellHints().setting(name, value))
    assert flag == FLAGS["settings"]
    for settings in (in_python, [assignment]):
        assert toml.to_dict(toml.resolve(Config(), None, settings), [name]) == toml.to_dict(
            toml.resolve(Config(), None, {name: value}), [name]
        )
