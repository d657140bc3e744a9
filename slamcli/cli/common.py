"""Options that several commands share."""

from __future__ import annotations

import functools
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    import numpy as np

    from slamcli.runs.run_directory import RunDir

Function = TypeVar("Function", bound=Callable[..., Any])

SELECTION = ("start", "end", "every", "fps", "known_camera")  # options of the section `recording` that have a flag


def complete_setting(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the name of an option for -s, and its value where there are only a few."""
    from slamcli.config import toml

    name, equals, value = incomplete.partition("=")
    if equals:
        return [CompletionItem(f"{name}={choice}") for choice in toml.choices(name) if choice.startswith(value)]
    return [CompletionItem(f"{key}=") for key in toml.known_keys() if key.startswith(incomplete)]


def complete_config(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the name of a shipped configuration, or a file."""
    from slamcli.config import toml

    named = [CompletionItem(name) for name in toml.shipped() if name.startswith(incomplete)]
    return named or [CompletionItem(incomplete, type="file")]


def complete_target(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete a recording: demo, one in the data folder, or any folder."""
    data = Path(context.params.get("data") or os.environ.get("SLAMCLI_DATA") or "data")
    names = [
        "demo",
        *(path.relative_to(data).as_posix() for pattern in ("*", "*/*") for path in sorted(data.glob(pattern)) if path.is_dir()),
    ]
    return [CompletionItem(name) for name in names if name.startswith(incomplete)] or [CompletionItem(incomplete, type="dir")]


def complete_run(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete a run below runs/, or any folder."""
    found = [path.parent.as_posix() for pattern in ("*/run.json", "*/*/run.json") for path in sorted(Path("runs").glob(pattern))]
    return [CompletionItem(name) for name in found if name.startswith(incomplete)] or [CompletionItem(incomplete, type="dir")]


run_option = click.option(
    "-r",
    "--run",
    metavar="DIR",
    shell_complete=complete_run,
    help="The run directory, or its name under runs/. [default: $SLAMCLI_RUN, else runs/latest]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs.")
set_option = click.option(
    "-s",
    "--set",
    "assignments",
    multiple=True,
    metavar="KEY=VALUE",
    shell_complete=complete_setting,
    help="Set an option, such as -s track.min_inliers=20.",
)
config_option = click.option(
    "--config",
    "config_name",
    metavar="NAME|FILE",
    shell_complete=complete_config,
    help="Start from fast, accurate, default or a TOML file.",
)


class Mount(click.ParamType):
    """A camera's place on a robot, as six numbers of a URDF's origin."""

    name = "x,y,z,roll,pitch,yaw"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Read six finite numbers."""
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 6 or not all(math.isfinite(number) for number in numbers):
            self.fail(f"{value!r} is not x,y,z,roll,pitch,yaw such as 0.1,0,0.3,0,0.2,0", param, ctx)
        return numbers


mount_option = click.option(
    "--mount",
    type=Mount(),
    help="Where the camera's body is on the robot's base [m, rad], as a URDF origin; the poses are then the base's.",
)


frame_option = click.option(
    "--frame", type=click.Choice(["world", "level"]), default="world", show_default=True, help="level: z up, floor at z = 0."
)


def told_in(folder: RunDir, T_wc: np.ndarray, frame: str, mount: tuple[float, ...] | None) -> np.ndarray:
    """Bring poses (N, 4, 4) of a run's camera, camera to world, into the frame asked for, with a mount as poses of the robot's base."""
    from slamcli.navigation.robot_pose import base_in_camera
    from slamcli.schema import Ground

    if frame == "level":
        ground = folder.load(Ground, "densify")
        if not ground.is_found:
            click.echo("Warning: no floor was found in this run, so the level frame is only a guess at which way is up", err=True)
        T_wc = ground.T_lw @ T_wc
    return T_wc if mount is None else T_wc @ base_in_camera(mount)


class Target(click.Path):
    """A file or folder that a command is to write: nowhere in a run directory, which holds what the run's own commands put there.

    own : the name under which the command itself puts it into a run directory, where it may be named, too
    is_folder : a folder, no file
    """

    def __init__(self, *, own: str = "", is_folder: bool = False) -> None:
        super().__init__(path_type=Path, dir_okay=is_folder, file_okay=not is_folder, readable=False)
        self.own = own

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Refuse a place in a run directory before any work is done."""
        from slamcli.runs.places import refuse_inside

        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        refuse_inside(path, own=self.own)
        return path


def _voice(context: click.Context, parameter: click.Parameter, value: int) -> int:
    """Set how much is told, by what the group and the command were given together."""
    from slamcli import console

    told = context.find_root().ensure_object(dict)
    told[str(parameter.name)] = told.get(str(parameter.name), 0) + value
    console.set_up(told.get("verbose", 0), quiet=bool(told.get("quiet", 0)))
    return value


def verbose_option(function: Function) -> Function:
    """Add `-v` and `--quiet`, which count on the group and on the command together."""
    quiet = click.option("--quiet", is_flag=True, expose_value=False, callback=_voice, help="Show nothing but warnings and errors.")
    verbose = click.option("-v", "--verbose", count=True, expose_value=False, callback=_voice, help="Show more; -vv shows everything.")
    return quiet(verbose(function))


def tell_written(out: Path, as_json: bool, text: str, **figures: Any) -> None:
    """Say on stderr what was written, or print it on stdout as JSON: `out` and the figures."""
    if as_json:
        click.echo(json.dumps({"out": str(out), **figures}))
    else:
        click.echo(f"{out}: {text}", err=True)


def check_ending(out: Path, *endings: str) -> str:
    """Return the ending of a file to be written; SlamError when it is none of `endings`."""
    from slamcli.errors import SlamError

    if out.suffix.lower() not in endings:
        raise SlamError(f"{out}: the name must end in {' or '.join(endings)}")
    return out.suffix.lower()


def recording_options(function: Function) -> Function:
    """Add the options that choose a part of a recording and fill in what it does not say; they arrive as `selection`, settings by name."""

    @functools.wraps(function)
    def wrapped(*args: Any, **values: Any) -> Any:
        selection = {f"recording.{name}": value for name in SELECTION if (value := values.pop(f"recording_{name}")) is not None}
        if "recording.known_camera" in selection:  # good to some per cent: the recording itself tells more
            selection["optimize.intrinsics"] = True
        return function(*args, selection=selection, **values)

    options = (
        click.option("--start", "recording_start", type=click.FloatRange(min=0), metavar="S", help="Begin S seconds after the first frame."),
        click.option("--end", "recording_end", type=click.FloatRange(min=0), metavar="S", help="Stop S seconds after the first frame."),
        click.option("--every", "recording_every", type=click.IntRange(min=1), metavar="N", help="Use every N-th frame."),
        click.option("--fps", "recording_fps", type=click.FloatRange(min=0, min_open=True), metavar="HZ", help="Frame rate, where stamps are missing or are no clock."),
        click.option("--camera", "recording_known_camera", metavar="NAME", help="Nominal intrinsics of a known camera: kinect1, d435, azure ..."),
    )  # fmt: skip
    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped  # type: ignore[return-value]  # click's options keep what they decorate
