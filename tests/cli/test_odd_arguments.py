"""Every command, with every one of its options given something that a clumsy user or an attacker might: one line, and no traceback."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from click.testing import Result

from slamcli.cli.main import cli

Slamcli = Callable[..., Result]

NUMBERS = ("nan", "inf", "-1", "1e308", "-1e308", "9" * 30, "1" * 400, "abc")
TEXTS = ("", "nan", "a\nb", "\udcff", "x" * 300, "/dev/null", ".", "~nouser/x", "=", "a=b=c", "nan,inf", "1e308,1e308", "-1,-1", "\x1b[31m")
ARGUMENTS = {  # of commands that need some, or that would work for long without
    "add": ["no_run", "no_recording"],
    "compare": ["no_run", "no_run"],
    "convert": ["no_recording", "out"],
    "localize": ["no_run", "no_recording"],
    "inspect": ["no_recording"],
    "inspect-features": ["no_recording"],
    "run": ["no_recording"],
    "batch": ["no_recording", "--dry-run"],
    "clean": ["--keep", "results"],
    "simulate": ["out", "--frames", "1", "--width", "16", "--height", "12"],
    "plan": ["--start", "0,0", "--goal", "1,1"],
    "vocab train": ["out.npz", "no_recording"],
    "vocab import": ["no_words.txt", "out.npz"],
    "vocab export": ["out.txt", "no_words.npz"],
    "vocab info": ["no_words.npz"],
}
OUT = {"export-octree": "m.bt", "export-cloud": "c.ply", "export-mesh": "m.ply", "export-grid": "m.pgm", "export-plan": "p.svg", "archive": "a.zip", "render": "r.png", "export-trajectory": "t.txt", "export-colmap": "colmap", "export-nerfstudio": "nerf"}  # fmt: skip


def leaves(group: click.Group, *path: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from leaves(command, *path, name)
        else:
            yield (*path, name), command


COMMANDS = dict(leaves(cli))


def odd(parameter: click.Parameter) -> tuple[str, ...]:
    if isinstance(parameter.type, (click.types.IntParamType, click.types.FloatParamType, click.Tuple)):
        return NUMBERS
    return TEXTS


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_nothing_that_is_typed_ends_in_a_traceback(slamcli: Slamcli, here: Path, path: tuple[str, ...]) -> None:
    command, name = COMMANDS[path], " ".join(path)
    base = ARGUMENTS.get(name) or ([OUT[name]] if name in OUT else [])
    for parameter in command.params:
        if isinstance(parameter, click.Option) and not parameter.is_flag and not parameter.count:
            for value in odd(parameter):
                given = [*path, *base, f"{max(parameter.opts, key=len)}", *[value] * parameter.nargs]
                check(slamcli(*given), given)
        elif isinstance(parameter, click.Argument):
            place = [one for one in command.params if isinstance(one, click.Argument)].index(parameter)
            for value in TEXTS:
                given = [*path, *base[:place], value, *base[place + 1 :]]
                check(slamcli(*given), given)
    assert not [path for path in here.rglob("*") if path.name.endswith(".part")]


def check(result: Result, given: list[str]) -> None:
    assert result.exception is None or isinstance(result.exception, SystemExit), (given, result.exception)
    assert result.exit_code in (0, 1, 2), given
    assert "Traceback" not in result.output, given
    assert len([line for line in result.stderr.splitlines() if line.startswith("Error")]) <= 1, given


def test_a_name_that_is_no_text_is_told_or_taken(slamcli: Slamcli, room_run: Path, here: Path) -> None:
    run = here / os.fsdecode(b"n\xff")
    shutil.copytree(room_run, run)
    for words in (["export-cloud", "c.ply"], ["report", "--no-inspect", "-o", "r.html"], ["export-trajectory", "t.txt"]):
        assert slamcli(*words, "-r", run).exit_code == 0, words
    result = slamcli("archive", "a.zip", "-r", run.resolve().rename(here / os.fsdecode(b"m\xff")))
    assert result.exit_code == 1 and "not valid utf-8; rename" in result.stderr
    assert not (here / "a.zip").exists()
