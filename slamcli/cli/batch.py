"""slamcli batch."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli.cli.common import complete_target, config_option, json_option, set_option
from slamcli.stages import NAMES

if TYPE_CHECKING:
    from distributed import Client

    from slamcli.batch.jobs import Job, Order


@click.command("batch", short_help="Run many recordings on this machine's cores or on a Dask cluster.")
@click.argument("recordings", nargs=-1, required=True, metavar="RECORDING|LIST.txt...", shell_complete=complete_target)
@click.option("--out", default="runs", show_default=True, metavar="DIR|URL", help="Folder of the runs, one for each recording.")
@click.option("--cluster", metavar="ADDRESS", help="A Dask scheduler, such as tcp://host:8786. [default: workers on this machine]")
@click.option("--workers", type=click.IntRange(1, 1024), help="Worker processes on this machine. [default: by its cores and memory]")
@click.option("--threads", type=click.IntRange(1, 64), help="Threads of each stage. [default: cores per worker; with --cluster 1]")
@click.option(
    "--retries",
    type=click.IntRange(0, 100),
    default=2,
    show_default=True,
    help="How often a task that failed through a machine's fault is tried again.",
)
@click.option("--until", type=click.Choice(NAMES), default=NAMES[-1], show_default=True, help="Stop each recording after this stage.")
@click.option("--data", metavar="DIR", help="Folder of recordings. [default: $SLAMCLI_DATA, else ./data]")
@click.option("--dry-run", is_flag=True, help="Say what would be run, and run nothing.")
@config_option
@set_option
@json_option
def batch(
    recordings: tuple[str, ...], out: str, cluster: str | None, workers: int | None, threads: int | None, retries: int, until: str,
    data: str | None, dry_run: bool, config_name: str | None, assignments: tuple[str, ...], as_json: bool,
) -> None:  # fmt: skip
    """Make a run of each of many recordings below --out; runs that are up to date are kept, so the same command can be given again.

    RECORDING is what `slamcli run` takes, or a URL such as s3://bucket/monday; LIST.txt has one per line. Writes batch.csv and batch.html
    into --out: state, coverage, error, doubts and cost of every recording, and the reason for each that failed. Exit status 1 when one failed.

    \b
      pip install 'slamcli[cluster]'
      slamcli batch recordings/* --out runs/week
      slamcli batch list.txt --out s3://maps/week --cluster tcp://scheduler:8786
    """
    from slamcli import console
    from slamcli.batch import cluster as dask_cluster
    from slamcli.batch import figures, jobs

    if cluster is not None and workers is not None:
        raise click.UsageError("--workers is for this machine; a --cluster has its own")
    order = _order(out, config_name, assignments, data, until, threads or 1)
    found = jobs.jobs(recordings, order)
    if dry_run:
        click.echo(_plan(found))
        return
    with jobs.prepared(order) as order:
        connection: AbstractContextManager[Client]
        if cluster is not None:
            connection = dask_cluster.remote(cluster)
        else:
            n, share, memory = dask_cluster.local_size(workers)
            order = jobs.with_threads(order, threads or share)
            connection = dask_cluster.local(n, memory, progress=console.progress, tell=console.say)
        rows: list[dict[str, Any]] = []
        with connection as client:
            for row in dask_cluster.work_off(client, jobs.jobs(recordings, order), retries=retries, progress=console.progress):
                rows.append(row)
                console.say(f"{len(rows)}/{len(found)}  {figures.as_line(row)}")
    rows.sort(key=lambda row: [job.run for job in found].index(row["run"]))
    written = figures.write(order.out, rows)
    click.echo(json.dumps(rows, indent=1) if as_json else "\n".join(written))
    if any(row["state"] == "failed" for row in rows):
        click.get_current_context().exit(1)


def _order(out: str, config_name: str | None, assignments: tuple[str, ...], data: str | None, until: str, threads: int) -> Order:
    """Check the settings here, before any worker meets them."""
    import os

    from slamcli.batch.jobs import Order, absolute_out
    from slamcli.batch.storage import is_url
    from slamcli.config import toml
    from slamcli.runs.places import refuse_inside

    out = absolute_out(out)
    if not is_url(out):
        refuse_inside(Path(out, "batch.csv"))

    config = toml.read(toml.find(config_name)) if config_name else None
    toml.resolve(config, None, assignments)
    data = data or os.environ.get("SLAMCLI_DATA")
    folder = os.path.abspath(data) if data else None
    return Order(out, settings=assignments, config=config, data=folder, until=until, threads=threads)


def _plan(found: list[Job]) -> str:
    """Tell of each recording what is there and what would be run."""
    from slamcli.batch.storage import finished_stages
    from slamcli.console import table

    rows = [["recording", "run", "there", "to run"]]
    for job in found:
        there = [stage for stage in finished_stages(job.run) if stage in job.stages]
        rows.append([job.recording, job.run, " ".join(there) or "-", " ".join(s for s in job.stages if s not in there) or "-"])
    return table(rows)
