"""slamcli list, clean, archive."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamcli.cli.common import Target, check_ending, json_option, run_option
from slamcli.hints import run_flag

if TYPE_CHECKING:
    from slamcli.runs.housekeeping import Listed


@click.command("list", short_help="List the runs here.")
@click.argument("folder", default="runs", type=click.Path(path_type=Path, file_okay=False))
@json_option
def list_command(folder: Path, as_json: bool) -> None:
    """List the runs below FOLDER (runs): recording, stages, frames with a pose, size on disk. The star marks the last one that run or add made."""
    from slamcli import console
    from slamcli.runs import housekeeping

    found = housekeeping.list_runs(folder)
    if as_json:
        click.echo(json.dumps([one.to_dict() for one in found], indent=1))
    elif found:
        click.echo(console.table([["run", "recording", "last stage", "frames", "size"], *map(_row, found)], right=(4,)))
        for one in found:
            if one.damage:
                click.echo(f"Warning: {one.damage}", err=True)
    else:
        click.echo(f"no run below {folder}; make one with: slamcli run demo", err=True)


def _row(one: Listed) -> list[str]:
    frames = "" if one.frames is None else f"{one.frames}" if one.located is None else f"{one.located} of {one.frames}"
    return [
        f"{one.path}{' *' if one.is_latest else ''}",
        one.recording,
        "damaged" if one.damage else one.stages[-1] if one.stages else "-",
        frames,
        f"{one.size / 1e6:.1f} MB",
    ]


@click.command("clean", short_help="Delete the files that only stages read, and keep the results.")
@run_option
@click.option(
    "--keep", type=click.Choice(["results"]), required=True, help="What stays; results: trajectory, cloud, octree, grid, pose graph."
)
@json_option
def clean_command(run: str | None, keep: str, as_json: bool) -> None:
    """Delete a run's features, matches and maps before loop closing; trajectory, cloud, octree, grid and pose graph stay.

    Exports of these, and plan, go on working. slamcli run makes the deleted stages again, from the recording.

    \b
      slamcli clean --keep results -r runs/demo
    """
    from slamcli.runs import housekeeping
    from slamcli.runs.run_directory import RunDir

    folder = RunDir.find(run)
    if run is None and "SLAMCLI_RUN" not in os.environ:
        raise click.UsageError(f"say whose files are to be deleted; the run made last is that of: {run_flag(folder.path)}")
    freed = housekeeping.clean(folder)
    if as_json:
        click.echo(json.dumps({"run": str(folder.path), "kept": keep, "freed": freed}))
    else:
        click.echo(
            f"{folder.path}: {sum(freed.values()) / 1e6:.1f} MB freed ({', '.join(freed) or 'nothing was left to delete'})", err=True
        )


@click.command("archive", short_help="Pack a run into one zip file.")
@click.argument("out", type=Target())
@run_option
@click.option("--results", is_flag=True, help="Leave out the files that only stages read.")
@click.option("--overwrite", is_flag=True, help="Even where OUT is an archive of more than this one.")
@json_option
def archive_command(out: Path, run: str | None, results: bool, overwrite: bool, as_json: bool) -> None:
    """Pack a run into OUT (.zip), whole or only its results; unpacked anywhere, it is a run again.

    \b
      slamcli archive demo.zip --results -r runs/demo
    """
    from slamcli.runs import housekeeping
    from slamcli.runs.run_directory import RunDir

    check_ending(out, ".zip")
    folder = RunDir.find(run)
    n = housekeeping.archive(folder, out, skip=housekeeping.NO_RESULTS if results else (), overwrite=overwrite)
    if as_json:
        click.echo(json.dumps({"out": str(out), "files": n, "bytes": out.stat().st_size}))
    else:
        click.echo(f"{out}: {n} files, {out.stat().st_size / 1e6:.1f} MB", err=True)
