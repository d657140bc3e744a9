"""slamcli inspect, report, view."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli.cli.common import Target, complete_target, json_option, recording_options, run_option

if TYPE_CHECKING:
    from slamcli.inspection import Inspection
    from slamcli.runs.run_directory import RunDir

BAR = 30  # characters of the longest bar in a histogram


@click.command("inspect", short_help="Find what is wrong with a recording before time is spent on it.")
@click.argument("recording", shell_complete=complete_target)
@click.option("--data", metavar="DIR", help="Folder of recordings. [default: $SLAMCLI_DATA, ./data, the user's cache]")
@click.option(
    "--depth-scale", type=click.FloatRange(min=0, min_open=True), help="Depth units per metre to assume instead of the recording's own."
)
@recording_options
@json_option
def inspect_command(recording: str, data: str | None, depth_scale: float | None, as_json: bool, selection: dict[str, Any]) -> None:
    """Find what is wrong with a recording before time is spent on it.

    Every image is read once. The exit status is 1 if a run would not make sense.
    """
    from slamcli import console, inspection
    from slamcli.config import toml

    camera = {"depth_scale": depth_scale} if depth_scale is not None else None
    options = toml.resolve(None, None, selection).recording
    found = inspection.inspect(recording, data=data, camera=camera, options=options, progress=console.progress)
    click.echo(json.dumps(found.to_dict(), indent=1) if as_json else _as_text(found))
    if found.level == inspection.ERROR:
        click.get_current_context().exit(1)


def _as_text(found: Inspection) -> str:
    lines = [found.recording, *_facts(found.facts), ""] if found.facts else [found.recording, ""]
    for finding in found.findings:
        lines.append(f"{finding.level}: {finding.message}")
        if finding.advice:
            lines.append(f"    {finding.advice}")
    return "\n".join([*lines, f"verdict: {found.verdict}"])


def _facts(facts: dict) -> list[str]:
    size, depth = facts["size"], facts["depth_m"]
    truth, length = "yes" if facts["has_ground_truth"] else "no", f"{facts['duration_s']:.1f} s at {facts['rate_hz']:.1f} Hz"
    lines = [
        f"  format         {facts['format']}, {size[0]} x {size[1]} px, ground truth: {truth}",
        f"  frames         {facts['frames']}, {facts['frames_with_depth']} with depth; {length}",
    ]
    if depth:
        lines.append(
            f"  depth          {depth['p05']:.2f} to {depth['p95']:.2f} m (5 to 95 %), median {depth['p50']:.2f} m, "
            f"scale {facts['depth_scale']:g}; holes {facts['holes']:.0%}"
        )
    if facts["depth_shift_px"] is not None:
        lag = f", {1000 * facts['depth_lag_s']:+.0f} ms" if facts["depth_lag_s"] is not None else ""
        lines.append(
            f"  depth edges    fit colour when moved by ({facts['depth_shift_px'][0]:+.0f}, {facts['depth_shift_px'][1]:+.0f}) px{lag}"
        )
    if facts["blur"] is not None:
        lines.append(
            f"  pictures       blur {facts['blur']:.2f} (0 sharp, 1 blurred), {facts['saturated']:.0%} burnt out, "
            f"mean grey {facts['mean_grey']:.0f}, {facts['corners']:.0f} corners"
        )
    if facts["offset_median_s"] is not None:
        median, p95 = 1000 * facts["offset_median_s"], 1000 * facts["offset_p95_s"]
        lines.append(f"  depth - colour {median:.1f} ms apart (median), {p95:.1f} ms (95 %)")
        most = max(n for _, _, n in facts["offset_histogram"]) or 1
        lines += [
            f"    {1000 * a:+4.0f} .. {1000 * b:+4.0f} ms {n:6d} {'#' * round(BAR * n / most)}".rstrip()
            for a, b, n in facts["offset_histogram"]
        ]
    return lines


@click.command(short_help="Write one HTML page about a run.")
@run_option
@click.option("-o", "--out", type=Target(own="report.html"), help="Where the page goes. [default: report.html in the run directory]")
@click.option(
    "--inspect/--no-inspect", "with_inspection", default=True, help="Look through the recording for faults; done once per recording."
)
def report(run: str | None, out: Path | None, with_inspection: bool) -> None:
    """Write one HTML page about a run: trajectory, errors, maps, timings, warnings, configuration.

    The page is one file: it needs no network and no folder beside it.
    """
    from slamcli import report as report_page
    from slamcli.evaluation.run_trajectories import last_stage
    from slamcli.runs.run_directory import RunDir

    folder = RunDir.find(run)
    last_stage(folder)  # there is something to report, or this says what is missing
    target = out or folder.own_file("report.html")
    report_page.make(folder, target, inspected=_findings(folder) if with_inspection else ())
    click.echo(target)


def _findings(folder: RunDir) -> list[tuple[str, str]]:
    """Inspect a run's recording, or read what an earlier look at the same recording found; nothing where it is gone."""
    from slamcli import console, files, inspection
    from slamcli.errors import SlamError

    kept, digest = folder.path / "inspection.json", folder.info()["digest"]
    try:
        known = {}
        with contextlib.suppress(SlamError, OSError):  # not there yet, or damaged
            known = files.read_sealed(kept)
        if known.get("digest") != digest:
            roots = [entry["root"] for entry in folder.recordings] or [folder.info()["root"]]
            camera = dict(folder.config().camera) or None
            found = [inspection.inspect(root, camera=camera, progress=console.progress).to_dict() for root in roots]
            known = {"digest": digest, **found[0], "findings": [finding for one in found for finding in one["findings"]]}
            files.write_sealed(kept, known)
        return [(one["level"], f"{one['message']}: {one['advice']}".removesuffix(": ")) for one in known["findings"]]
    except (SlamError, OSError, KeyError, TypeError, AttributeError) as error:
        console.say(f"the recording is not inspected: {error}")
        return []


@click.command(short_help="Show a run in the Rerun viewer.")
@run_option
@click.option("--save", type=Target(), metavar="FILE", help="Write FILE (.rrd) instead; needs no display.")
@click.option("--images", default=300, show_default=True, type=click.IntRange(min=0), help="Frames shown with their image, at most.")
def view(run: str | None, save: Path | None, images: int) -> None:
    """Show a run in the Rerun viewer: images, features, key frames, loops, cloud, octree, grid over time.

    \b
      pip install 'slamcli[view]'
      slamcli view
      slamcli view --save run.rrd       look at it elsewhere with: rerun run.rrd
    """
    from slamcli import console
    from slamcli.runs.run_directory import RunDir
    from slamcli.visualization import rerun_viewer as viewer

    viewer.load_rerun()
    viewer.view(RunDir.find(run), save=save, images=images, progress=console.progress)
    if save is not None:
        click.echo(save)
