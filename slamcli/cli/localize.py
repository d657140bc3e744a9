"""slamcli localize."""

from __future__ import annotations

import json
from pathlib import Path

import click

from slamcli.cli.common import Target, json_option


@click.command("localize", short_help="Find a new recording's camera in the map of an old run.")
@click.argument("run")
@click.argument("recording")
@click.option("--out", default="localized.txt", show_default=True, type=Target(), help="Where the trajectory goes (TUM format).")
@click.option("--data", metavar="DIR", help="Folder of recordings. [default: $SLAMCLI_DATA, ./data, the user's cache]")
@json_option
def localize(run: str, recording: str, out: Path, data: str | None, as_json: bool) -> None:
    """Find the camera of RECORDING in the map of RUN, a run directory, and write its trajectory in that run's world frame.

    The map is not changed. Frames that show nothing of it have no pose; the command says how many have one.

    \b
      slamcli localize runs/tum/fr1_room path/to/next/day --out next_day.txt
    """
    from slamcli import console
    from slamcli.datasets import open_dataset
    from slamcli.formats.trajectory import write_tum
    from slamcli.runs.localization import localize
    from slamcli.runs.run_directory import RunDir

    folder = RunDir.find(run)
    dataset = open_dataset(recording, data=data, camera=dict(folder.config().camera) or None, progress=console.progress)
    found = localize(folder, dataset, progress=console.progress)
    write_tum(out, found.trajectory)
    figures = found.to_dict()
    click.echo(
        json.dumps({"out": str(out), **figures}, indent=1)
        if as_json
        else f"{out}: {figures['n_poses']} of {figures['n_frames']} frames found in {folder.path}"
    )
