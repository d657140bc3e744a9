"""slamcli compare."""

from __future__ import annotations

import json
from pathlib import Path

import click

from slamcli.cli.common import Target, check_ending, complete_run, json_option


@click.command("compare", short_help="Put several runs side by side.")
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN...", shell_complete=complete_run)
@click.option("-o", "--out", type=Target(), help="Also write the table as one HTML page.")
@json_option
def compare_command(runs: tuple[str, ...], out: Path | None, as_json: bool) -> None:
    """Put runs side by side: settings that differ, time, error, frames located, what speaks against each map, and how the maps differ.

    Each is compared with the first. RUN is a run directory, or its name under runs/.

    \b
      slamcli run demo -r runs/plain
      slamcli run demo -r runs/quick --config fast
      slamcli compare plain quick -o compare.html
    """
    from slamcli import console, files
    from slamcli.evaluation import run_comparison
    from slamcli.report import comparison
    from slamcli.runs.run_directory import RunDir

    if len(runs) < 2:
        raise click.UsageError("name two runs at least")
    if out is not None:
        check_ending(out, ".html")
    folders = [RunDir.find(name) for name in runs]
    found = run_comparison.compare(folders, runs)
    table = run_comparison.rows(found)
    if out is not None:
        files.write_text(out, comparison.render(table, found))
        click.echo(f"{out}: the comparison as a page", err=True)
    click.echo(json.dumps([one.to_dict() for one in found], indent=1) if as_json else console.table(table))
