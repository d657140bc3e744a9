"""slamcli eval ape | rpe | map."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from slamcli.cli.common import Target, complete_run, json_option, run_option
from slamcli.stages import WITH_TRAJECTORY

if TYPE_CHECKING:
    import numpy as np

    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Trajectory

Given = TypeVar("Given")

APE_COLUMNS = {
    "name": ("trajectory", ""),
    "stage": ("stage", ""),
    "rmse": ("RMSE [m]", ".4f"),
    "mean": ("mean", ".4f"),
    "median": ("median", ".4f"),
    "std": ("std", ".4f"),
    "max": ("max", ".4f"),
    "n_frames": ("frames", "d"),
    "lost": ("lost", "d"),
    "coverage": ("coverage", ".1%"),
    "n_matched": ("compared", "d"),
    "scale": ("scale", ".4f"),
    "rmse_scaled": ("RMSE scaled [m]", ".4f"),
    "doubtful": ("doubtful", "d"),
    "rmse_sure": ("RMSE sure [m]", ".4f"),
}
RPE_COLUMNS = {
    "name": ("trajectory", ""),
    "stage": ("stage", ""),
    "delta": ("over", "g"),
    "unit": ("unit", ""),
    "rmse": ("RMSE [m]", ".4f"),
    "median": ("median", ".4f"),
    "max": ("max", ".4f"),
    "rotation_rmse_deg": ("RMSE [deg]", ".3f"),
    "rotation_median_deg": ("median", ".3f"),
    "rotation_max_deg": ("max", ".3f"),
    "n_pairs": ("pairs", "d"),
    "coverage": ("coverage", ".1%"),
}


@click.group("eval")
def eval_group() -> None:
    """Compare a run with the truth."""


def _trajectory_options(function: Any) -> Any:
    """Add what ape and rpe have in common."""
    for decorator in (
        click.argument("runs", nargs=-1, metavar="[RUN]...", shell_complete=complete_run),
        run_option,
        click.option(
            "--stage",
            type=click.Choice([*WITH_TRAJECTORY, "all"]),
            help="The stage whose trajectory is measured. [default: the last that has been run]",
        ),
        click.option(
            "--truth",
            type=click.Path(path_type=Path, dir_okay=False),
            metavar="FILE",
            help="True trajectory (TUM format) instead of the recording's.",
        ),
        click.option("--truth-offset", type=float, default=0.0, metavar="S", help="Seconds added to the stamps of the truth."),
        click.option("--other", multiple=True, metavar="NAME=FILE", help="Another system's trajectory of this recording (TUM format)."),
        click.option("--plot", type=Target(), metavar="FILE", help="Draw the errors (.png, .pdf, .svg)."),
        click.option("--style", type=click.Choice(["text", "csv", "latex"]), default="text", show_default=True, help="Form of the table."),
        json_option,
    ):
        function = decorator(function)
    return function


@eval_group.command("ape")
@_trajectory_options
def ape_command(
    runs: tuple[str, ...], run: str | None, stage: str | None, truth: Path | None, truth_offset: float, other: tuple[str, ...],
    plot: Path | None, style: str, as_json: bool,
) -> None:  # fmt: skip
    """Absolute pose error: SE(3) alignment, no scale, every colour frame that has a pose.

    \b
      slamcli eval ape                               the last run
      slamcli eval ape --stage all                   after each stage
      slamcli eval ape runs/a runs/b --style latex   several in one table
      slamcli eval ape --other ORB-SLAM3=f.txt --plot ape.png
      slamcli eval ape --truth mocap.txt --truth-offset -1.2

    Of a run of several recordings, first all together, then each under the same alignment; their truths must be told in one frame.
    """
    from slamcli.evaluation import of_several, plots, run_trajectories, tables, trajectory_error

    results, rows = [], []
    for folder in _open_runs(runs, run):
        true, n_frames = _truth(folder, truth, truth_offset), run_trajectories.frame_count(folder)
        for name, which, estimate in _trajectories(folder, stage, other):
            results.append(trajectory_error.ape(estimate, true, n_frames=n_frames, name=name, stage=which))
            rows.append(results[-1].to_dict() | run_trajectories.sure_figures(folder, results[-1]))
            if which and folder.recordings:
                rows[-1]["recordings"] = [_without_sure(one.to_dict()) for one in of_several.apes(folder, results[-1], true)]
            if which:
                _record(folder, "ape.json", rows[-1])
    if plot is not None:
        plots.plot_ape(results, plot)
        click.echo(f"{plot}: errors and paths", err=True)
    flat = [one for row in rows for one in (row, *row.get("recordings", []))]
    click.echo(_json(rows, several=_are_several(runs, stage, other)) if as_json else tables.render(flat, APE_COLUMNS, style))


@eval_group.command("rpe")
@_trajectory_options
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), default=1.0, show_default=True, help="Interval [s].")
def rpe_command(
    runs: tuple[str, ...], run: str | None, stage: str | None, truth: Path | None, truth_offset: float, other: tuple[str, ...],
    plot: Path | None, style: str, as_json: bool, seconds: float,
) -> None:  # fmt: skip
    """Relative pose error: drift over one second, and from one frame to the next."""
    from slamcli.evaluation import plots, tables, trajectory_error

    results, rows = [], []
    for folder in _open_runs(runs, run):
        true, frame_stamp = _truth(folder, truth, truth_offset), _frame_stamp(folder)
        for name, which, estimate in _trajectories(folder, stage, other):
            over_time, per_frame = (
                trajectory_error.rpe(estimate, true, frame_stamp=frame_stamp, name=name, stage=which, seconds=interval)
                for interval in (seconds, None)
            )
            results.append(over_time)
            rows.append({**over_time.to_dict(), "per_frame": per_frame.to_dict()})
            if which:
                _record(folder, "rpe.json", rows[-1])
    if plot is not None:
        plots.plot_rpe(results, plot)
        click.echo(f"{plot}: errors", err=True)
    flat = [part for row in rows for part in (row, row["per_frame"])]
    click.echo(_json(rows, several=_are_several(runs, stage, other)) if as_json else tables.render(flat, RPE_COLUMNS, style))


@eval_group.command("map")
@run_option
@json_option
def map_command(run: str | None, as_json: bool) -> None:
    """Measure the octree against the depth images and, for a simulated recording, the grid against its scene.

    The first replays the key frames and counts the cells of the octree whose state agrees, as OctoMap's eval_octree_accuracy does.
    """
    from slamcli import console
    from slamcli.evaluation import map_error
    from slamcli.runs.run_directory import RunDir

    folder = RunDir.find(run)
    figures: dict[str, Any] = {"octree": map_error.octree_accuracy(folder, progress=console.progress)}
    if folder.record("grid2d") is not None and map_error.has_scene(folder):
        figures["grid"] = map_error.grid_score(folder, progress=console.progress)
    _record(folder, "map.json", figures)
    click.echo(_json([figures]) if as_json else "\n".join(_map_lines(figures)))


def _map_lines(figures: dict[str, Any]) -> list[str]:
    octree = figures["octree"]
    share = f"{octree['accuracy']:.2%}" if octree["accuracy"] is not None else "none"
    lines = [f"octree: {share} of the cells seen are right ({octree['scans']} scans, {octree['wrong']} cells wrong)"]
    if grid := figures.get("grid"):
        lines += [
            f"grid: {grid['free_is_free']:.2%} of the cells called free are free",
            f"      {grid['floor_is_free']:.2%} of the floor seen is called free, {grid['floor_is_occupied']:.2%} occupied",
            f"      {grid['outline_is_occupied']:.2%} of the obstacles' outlines seen are occupied",
        ]
        lines += [
            f"      {name}: {box['outline_occupied']} of the {box['outline']} outline cells seen are occupied, {box['free']} of its {box['cells']} cells free"
            for name, box in grid["special"].items()
        ]
    return lines


def _open_runs(runs: tuple[str, ...], run: str | None) -> list[RunDir]:
    from slamcli.runs.run_directory import RunDir

    if runs and run is not None:
        raise click.UsageError("name runs either as arguments or with -r, not both")
    return [RunDir.find(name) for name in runs] if runs else [RunDir.find(run)]


def _label(folder: RunDir) -> str:
    """Name a run in a table: its place below runs/, which tells two runs of one recording apart."""
    from slamcli.runs.places import RUNS

    path = folder.path.resolve()
    return path.relative_to(RUNS.resolve()).as_posix() if path.is_relative_to(RUNS.resolve()) else path.name


def _without_sure(figures: dict[str, Any]) -> dict[str, Any]:
    """Leave open what is counted for the whole run alone."""
    return figures | {"doubtful": None, "rmse_sure": None}


def _frame_stamp(folder: RunDir) -> np.ndarray:
    from slamcli.evaluation.run_trajectories import last_stage
    from slamcli.schema import FrameTimes

    return folder.load(FrameTimes, last_stage(folder)).stamp


def _trajectories(folder: RunDir, stage: str | None, other: tuple[str, ...]) -> list[tuple[str, str, Trajectory]]:
    """Return (name, stage, trajectory) of the run's stages asked for, then of other systems, whose stage is ""."""
    from slamcli.evaluation import run_trajectories
    from slamcli.formats.trajectory import read_tum

    last = run_trajectories.last_stage(folder)
    stages = WITH_TRAJECTORY[: WITH_TRAJECTORY.index(last) + 1] if stage == "all" else (stage or last,)
    found = [(_label(folder), which, run_trajectories.stage_trajectory(folder, which)) for which in stages]
    for item in _of_one_recording(folder, other, "--other"):
        name, equals, file = item.partition("=")
        if not (name and equals and file):
            raise click.BadParameter(f"{item!r}: expected NAME=FILE, such as ORB-SLAM3=CameraTrajectory.txt", param_hint="--other")
        found.append((name, "", read_tum(Path(file))))
    return found


def _record(folder: RunDir, file: str, figures: dict) -> None:
    """Keep the figures with the run; one that may not be written to is evaluated all the same."""
    from slamcli import files
    from slamcli.errors import SlamError

    target = folder.path / "eval" / file
    try:
        with files.written(target):
            folder.own_file("eval")  # as a link it would lead out of the run
            target.parent.mkdir(exist_ok=True)
            files.write_sealed(target, figures)
    except SlamError as error:
        click.echo(f"Warning: {error}", err=True)


def _of_one_recording(folder: RunDir, given: Sequence[Given], flag: str) -> Sequence[Given]:
    """Refuse a trajectory from outside for a run of several recordings, whose stamps may overlap."""
    from slamcli.errors import SlamError

    if given and folder.recordings:
        inside = f"{folder.path}/recordings/{folder.recordings[0]['name']}"
        raise SlamError(f"{flag}: a run of several recordings has several clocks; evaluate each alone, such as: slamcli eval ape {inside}")
    return given


def _truth(folder: RunDir, file: Path | None, offset: float) -> Trajectory:
    """Read the true trajectory, from `file` or of the recording, its stamps moved by `offset` [s]."""
    from dataclasses import replace

    from slamcli.evaluation import run_trajectories
    from slamcli.formats.trajectory import read_tum

    given = _of_one_recording(folder, [file] if file is not None else [], "--truth")
    truth = read_tum(given[0]) if given else run_trajectories.ground_truth(folder)
    return replace(truth, stamp=truth.stamp + offset)


def _are_several(runs: tuple[str, ...], stage: str | None, other: tuple[str, ...]) -> bool:
    return len(runs) > 1 or stage == "all" or bool(other)


def _json(rows: list[dict], *, several: bool = False) -> str:
    """Write one object or, where several were asked for, a list, however many there are."""
    return json.dumps(rows if several else rows[0], indent=1)
