"""Options that several commands share."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

Function = TypeVar("Function", bound=Callable[..., Any])

run_option = click.option("-r", "--run", metavar="DIR", help="The run directory. [default: $SLAMCLI_RUN, else runs/latest]")
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON for programs.")
set_option = click.option(
    "-s", "--set", "assignments", multiple=True, metavar="KEY=VALUE", help="Set an option, such as -s track.min_inliers=20."
)
config_option = click.option("--config", "config_name", metavar="NAME|FILE", help="Start from fast, accurate, default or a TOML file.")


def _verbosity(context: click.Context, parameter: click.Parameter, count: int) -> int:
    from slamcli import console

    context.find_root().ensure_object(dict)
    total = context.find_root().obj["verbosity"] = context.find_root().obj.get("verbosity", 0) + count
    console.set_up(total)
    return count


def verbose_option(function: Function) -> Function:
    """Add `-v`, which counts on the group and on the command together."""
    option = click.option("-v", "--verbose", count=True, expose_value=False, callback=_verbosity, help="Tell more; -vv tells everything.")
    return option(function)
