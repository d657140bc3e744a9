"""slamcli formats, convert."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from slamcli.cli.common import Target, complete_target, json_option, recording_options


@click.command("formats", short_help="List the layouts of recordings that open, and how each is recognized.")
@json_option
def formats(as_json: bool) -> None:
    """List the layouts of recordings that open, and how each is recognized.

    A layout marked with an extra needs more than a plain install, such as: pip install 'slamcli[video]'
    """
    from slamcli.console import table
    from slamcli.datasets import READERS

    rows = [[reader.name, reader.title, reader.told_by, reader.extra] for reader in READERS]
    if as_json:
        names = ("name", "title", "told_by", "extra")
        click.echo(json.dumps([dict(zip(names, row, strict=True)) for row in rows], indent=1))
    else:
        click.echo(table([[name, title, told, f"[{extra}]" if extra else ""] for name, title, told, extra in rows]))
        click.echo("[video], [phone]: with pip install 'slamcli[video,phone]'", err=True)


@click.command("convert", short_help="Write a recording of any layout in the TUM layout.")
@click.argument("recording", shell_complete=complete_target)
@click.argument("out", type=Target(is_folder=True))
@click.option("--data", metavar="DIR", help="Folder of recordings. [default: $SLAMCLI_DATA, ./data, the user's cache]")
@recording_options
def convert(recording: str, out: Path, data: str | None, selection: dict[str, Any]) -> None:
    """Write RECORDING, of any layout that opens, into the new folder OUT in the TUM layout: lists, PNG images, camera.toml, truth.

    Depth is written registered to colour, 5000 units per metre. Frames whose colour cannot be read are left out.

    \b
      slamcli convert walk.mcap walk --start 10 --end 60
    """
    from slamcli import console
    from slamcli.config import toml
    from slamcli.datasets import open_dataset
    from slamcli.datasets.convert import write_tum_layout

    dataset = open_dataset(recording, data=data, options=toml.resolve(None, None, selection).recording, progress=console.progress)
    for warning in (*dataset.warnings, *write_tum_layout(dataset, out, progress=console.progress)):
        console.say(f"warning: {warning}")
    click.echo(out)
