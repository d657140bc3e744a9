"""The command line: one group, every command, and what an error looks like to its user."""

import errno
import importlib
import math
from collections.abc import Callable
from typing import Any

import click

from slamcli import __version__, files, hints, interruption
from slamcli.cli.common import verbose_option
from slamcli.errors import SlamError

LACKING = ("Cannot allocate", "failed to map", "start new thread", "load shared object")  # in the errors of libraries short of memory
NAME_SHOWN = 40  # letters on either side of one that no name may hold
TOPICS = (
    "run",
    "batch",
    "runs",
    "evaluate",
    "compare",
    "export",
    "maps",
    "render",
    "grid",
    "plan",
    "floor_plan",
    "visualize",
    "recordings",
    "localize",
    "simulate",
    "features",
    "vocab",
)  # modules of this package


class Group(click.Group):
    """A group that turns what the user can mend into one line, and lists its commands in the order in which they were added."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Keep the order of work instead of the alphabet's."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command. Status 1: the user can mend it; 130: interrupted, 143: terminated. The rest is a bug and keeps its traceback."""
        try:
            with interruption.raising(), hints.spoken(hints.ShellHints()):
                return super().invoke(ctx)
        except SlamError as error:
            raise click.ClickException(str(error)) from error
        except OSError as error:
            if error.errno == errno.EPIPE or (error.errno is None and not _lacks_memory(error)):
                raise
            raise click.ClickException(_told(error)) from error
        except UnicodeEncodeError as error:  # of a name, wherever it was to be written or said
            near = error.object[max(error.start - NAME_SHOWN, 0) : error.end + NAME_SHOWN]
            raise click.ClickException(f"{near!r}: a name that is not valid {error.encoding}; rename the file or folder") from error
        except (MemoryError, ImportError, RuntimeError) as error:
            if not _lacks_memory(error):
                raise
            raise click.ClickException("out of memory; close other programs or use fewer features, a coarser voxel") from error
        except (KeyboardInterrupt, SystemError) as error:
            if (found := interruption.found_in(error)) is None:
                raise
            click.echo(f"Error: {found}", err=True)
            ctx.exit(found.exit_status)


def _lacks_memory(error: Exception) -> bool:
    """Say whether memory, or the threads that need some, could not be had; a library may not even load then."""
    return isinstance(error, MemoryError) or any(said in str(error) for said in LACKING)


def _told(error: OSError) -> str:
    if error.errno is None:
        return f"too little memory to load a library, or it is damaged ({str(error).splitlines()[0]})"
    return f"{error.filename}: {files.told(error)}" if error.filename is not None else files.told(error)


@click.group(cls=Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="slamcli")
@verbose_option
def cli() -> None:
    """Turn a recording of a colour-and-depth camera into trajectory, cloud, octree and navigation grid.

    \b
      slamcli run demo                 a simulated room, nothing to download
      slamcli run tum/fr1_room         found under the data folder, else downloaded
      slamcli status                   what is up to date, stale and why, missing
      slamcli track -s track.min_inliers=20
      slamcli eval ape                 error against the true trajectory
      slamcli export-grid map.pgm      for map_server and nav2

    Commands that name no run use the last one.
    """


def _commands_of(module: Any) -> list[click.Command]:
    found = [value for value in vars(module).values() if isinstance(value, click.Command)] + list(getattr(module, "stage_commands", ()))
    members = {id(member) for group in found if isinstance(group, click.Group) for member in group.commands.values()}
    return [command for command in found if id(command) not in members]


def _finite(command: click.Command) -> click.Command:
    """Let a command take no number that is none: a bound of click lets nan pass, as no comparison with it holds."""
    for member in command.commands.values() if isinstance(command, click.Group) else ():
        _finite(member)
    for parameter in command.params:
        parameter.callback = _checking(parameter.callback)
    return command


def _checking(callback: Callable[..., Any] | None) -> Callable[..., Any]:
    def check(context: click.Context, parameter: click.Parameter, value: Any) -> Any:
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise click.BadParameter(f"{number} is not a finite number", context, parameter)
        return callback(context, parameter, value) if callback else value

    return check


for topic in TOPICS:
    for command in _commands_of(importlib.import_module(f"slamcli.cli.{topic}")):
        cli.add_command(_finite(verbose_option(command)))
