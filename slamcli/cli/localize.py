"""slamcli localize."""

from __future__ import annotations

import json
from pathlib import Path

import click

from slamcli.cli.common import Target, complete_run, complete_target, frame_option, json_option, mount_option, told_in


@click.command("localize", short_help="Find a new recording's camera in the map of an old run.")
@click.argument("run", shell_complete=complete_run)
@click.argument("recording", shell_complete=complete_target)
@click.option("--out", default="localized.txt", show_default=True, type=Target(), help="Where the trajectory goes (TUM format).")
@click.option("--data", metavar="DIR", help="Folder of recordings. [default: $SLAMCLI_DATA, ./data, the user's cache]")
@frame_option
@mount_option
@json_option
def localize(run: str, recording: str, out: Path, data: str | None, frame: str, mount: tuple[float, ...] | None, as_json: bool) -> None:
    """Find the camera of RECORDING in the map of RUN, a run directory, and write its trajectory in a frame of that run.

    The map is not changed. Frames that show nothing of it have no pose; the command says how many have one. With --frame level it also
    says where the last one stands on the floor: the initial pose of a robot that stands there now.

    \b
      slamcli localize runs/tum/fr1_room path/to/next/day --out next_day.txt
      slamcli localize runs/lab now --frame level --mount 0.1,0,0.3,0,0.2,0
    """
    import numpy as np

    from slamcli import console
    from slamcli.datasets import open_dataset
    from slamcli.formats.trajectory import write_tum
    from slamcli.navigation.robot_pose import base_pose, planar_pose
    from slamcli.runs.localization import localize
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Trajectory

    folder = RunDir.find(run)
    dataset = open_dataset(recording, data=data, camera=dict(folder.config().camera) or None, progress=console.progress)
    found = localize(folder, dataset, progress=console.progress)
    poses = told_in(folder, found.trajectory.T_wc, frame, mount)
    write_tum(out, Trajectory(stamp=found.trajectory.stamp, T_wc=poses))
    figures = found.to_dict() | {"frame": frame}
    said = f"{out}: {figures['n_poses']} of {figures['n_frames']} frames found in {folder.path}"
    if frame == "level":
        x, y, yaw = (round(value, 4) + 0.0 for value in (planar_pose(poses[-1]) if mount is None else base_pose(poses[-1], np.eye(4))))
        figures["last"] = {"x": x, "y": y, "yaw": yaw}
        said += f"\nlast: x {x} m, y {y} m, yaw {yaw} rad in the maps' frame"
    click.echo(json.dumps({"out": str(out), **figures}, indent=1) if as_json else said)
