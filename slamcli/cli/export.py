"""slamcli export-trajectory."""

from __future__ import annotations

import json
from pathlib import Path

import click

from slamcli.cli.common import check_ending, json_option, mount_option, run_option


@click.command("export-trajectory")
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False))
@run_option
@click.option("--stage", type=click.Choice(["track", "optimize", "loop"]), help="Whose trajectory; default: the last there is.")
@click.option("--frame", type=click.Choice(["world", "level"]), default="world", show_default=True, help="level: z up, floor at z = 0.")
@click.option("--format", "layout", type=click.Choice(["tum", "kitti"]), default="tum", show_default=True, help="kitti has no time stamps.")
@click.option("--sure-only", is_flag=True, help="Leave out the poses that the run itself doubts; of the final trajectory.")
@mount_option
@json_option
def export_trajectory(
    out: Path, run: str | None, stage: str | None, frame: str, layout: str, mount: tuple[float, ...] | None, as_json: bool, sure_only: bool
) -> None:
    """Write the camera's trajectory to OUT (.txt, .tum, .csv or .kitti): pose of the colour camera, camera to world.

    With --mount it is the robot's base instead: x ahead, y left, z up.

    \b
      slamcli export-trajectory path.txt --frame level
      slamcli export-trajectory base.txt --frame level --mount 0.1,0,0.3,0,0.2,0
    """
    from slamcli.evaluation import trajectory_error
    from slamcli.formats.trajectory import write_kitti, write_tum
    from slamcli.navigation.robot_pose import base_in_camera
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Ground, Trajectory

    check_ending(out, ".txt", ".tum", ".csv", ".kitti")
    folder = RunDir.find(run)
    trajectory = trajectory_error.stage_trajectory(folder, stage or trajectory_error.last_stage(folder))
    if sure_only:
        trajectory = trajectory_error.sure_part(folder, trajectory)
    T_wc = trajectory.T_wc
    if frame == "level":
        ground = folder.load(Ground, "densify")
        if not ground.is_found:
            click.echo("Warning: no floor was found in this run, so the level frame is only a guess at which way is up", err=True)
        T_wc = ground.T_lw @ T_wc
    if mount is not None:
        T_wc = T_wc @ base_in_camera(mount)
    (write_kitti if layout == "kitti" else write_tum)(out, Trajectory(stamp=trajectory.stamp, T_wc=T_wc))
    n_frames = trajectory_error.frame_count(folder)
    if as_json:
        click.echo(json.dumps({"out": str(out), "poses": len(trajectory.stamp), "frames": n_frames, "frame": frame, "format": layout}))
        return
    note = (
        "; a KITTI file has no stamps, so its lines are not frame numbers here"
        if layout == "kitti" and len(trajectory.stamp) < n_frames
        else ""
    )
    click.echo(f"{out}: {len(trajectory.stamp)} poses of {n_frames} frames{note}", err=True)
