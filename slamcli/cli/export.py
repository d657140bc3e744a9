"""slamcli export-trajectory."""

from __future__ import annotations

from pathlib import Path

import click

from slamcli.cli.common import run_option


@click.command("export-trajectory")
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False))
@run_option
@click.option("--stage", type=click.Choice(["track", "optimize", "loop"]), help="Whose trajectory; default: the last there is.")
@click.option("--frame", type=click.Choice(["world", "level"]), default="world", show_default=True, help="level: z up, floor at z = 0.")
@click.option("--format", "layout", type=click.Choice(["tum", "kitti"]), default="tum", show_default=True, help="kitti has no time stamps.")
def export_trajectory(out: Path, run: str | None, stage: str | None, frame: str, layout: str) -> None:
    """Write the camera's trajectory: pose of the colour camera, camera to world."""
    from slamcli.evaluation import trajectory_error
    from slamcli.formats.trajectory import write_kitti, write_tum
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Features, Ground, Trajectory

    folder = RunDir.find(run)
    trajectory = trajectory_error.stage_trajectory(folder, stage or trajectory_error.last_stage(folder))
    if frame == "level":
        ground = folder.load(Ground, "densify")
        if not ground.is_found:
            click.echo("Warning: no floor was found in this run, so the level frame is only a guess at which way is up", err=True)
        trajectory = Trajectory(stamp=trajectory.stamp, T_wc=ground.T_lw @ trajectory.T_wc)
    (write_kitti if layout == "kitti" else write_tum)(out, trajectory)
    n_frames = len(folder.load(Features, "extract").stamp)
    note = (
        "; a KITTI file has no stamps, so its lines are not frame numbers here"
        if layout == "kitti" and len(trajectory.stamp) < n_frames
        else ""
    )
    click.echo(f"{out}: {len(trajectory.stamp)} poses of {n_frames} frames{note}", err=True)
