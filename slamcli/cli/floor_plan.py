"""slamcli export-plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from slamcli import console
from slamcli.cli.common import Target, check_ending, json_option, run_option


@click.command("export-plan")
@click.argument("out", type=Target())
@run_option
@click.option("--wall-height", default=1.2, show_default=True, help="Height that walls reach up to at least [m].")
@click.option("--door-width", default=1.2, show_default=True, help="Width of the widest door between two rooms [m].")
@json_option
def export_plan(out: Path, run: str | None, wall_height: float, door_width: float, as_json: bool) -> None:
    """Write a floor plan to OUT: walls as straight lines, rooms with their areas, doors (.svg, .dxf or .json).

    \b
      slamcli export-plan plan.svg
      slamcli export-plan plan.dxf --wall-height 1.5
      slamcli export-plan rooms.json
    """
    from slamcli import api
    from slamcli.formats.floor_plan import WRITERS
    from slamcli.runs.run_directory import RunDir

    ending = check_ending(out, *WRITERS)
    plan = api.Run(RunDir.find(run)).floor_plan(wall_height=wall_height, door_width=door_width)
    about = plan.to_dict()
    WRITERS[ending](out, about)
    if as_json:
        click.echo(json.dumps({"out": str(out), **about}, indent=1))
    _tell(out, about, wall_height)


def _tell(out: Path, about: dict[str, Any], wall_height: float) -> None:
    """Say what was drawn, with the same rounded areas as in the drawing."""
    walls, rooms, doors = console.counts({name: len(about[name]) for name in ("walls", "rooms", "doors")})
    areas = ", ".join(f"{room['area_m2']:.1f}" for room in about["rooms"])
    click.echo(f"{out}: {walls}, {rooms}{f' ({areas} m2)' if areas else ''}, {doors}", err=True)
    if not about["walls"]:
        click.echo(f"Warning: no wall was seen up to {wall_height:g} m: rooms end at all obstacles; try a lower --wall-height", err=True)
