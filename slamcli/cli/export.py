"""slamcli export-trajectory, export-colmap, export-nerfstudio."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamcli.cli.common import Target, check_ending, frame_option, json_option, mount_option, run_option, tell_written, told_in
from slamcli.formats import TRAJECTORY_FORMATS
from slamcli.stages import WITH_TRAJECTORY

if TYPE_CHECKING:
    import numpy as np

    from slamcli.runs.posed_images import PosedImages
    from slamcli.runs.run_directory import RunDir

CLOUD = "sparse_pc.ply"  # the name under which nerfstudio's own converters write it
FORMAT_OF = {ending: name for name, endings in TRAJECTORY_FORMATS.items() for ending in endings}


@click.command("export-trajectory")
@click.argument("out", type=Target())
@run_option
@click.option(
    "--stage",
    type=click.Choice(WITH_TRAJECTORY),
    help="The stage whose trajectory is written; default: the last that has been run.",
)
@frame_option
@click.option(
    "--format", "format_name", type=click.Choice(list(TRAJECTORY_FORMATS)), help="[default: by OUT's ending]; kitti has no time stamps."
)
@click.option("--recording", metavar="NAME", help="Of a run of several recordings, the poses of this one, at its own stamps.")
@click.option("--sure-only", is_flag=True, help="Leave out the poses that the run itself doubts; only for the final trajectory.")
@mount_option
@json_option
def export_trajectory(
    out: Path,
    run: str | None,
    stage: str | None,
    frame: str,
    format_name: str | None,
    mount: tuple[float, ...] | None,
    as_json: bool,
    sure_only: bool,
    recording: str | None,
) -> None:
    """Write the camera's trajectory to OUT: pose of the colour camera, camera to world.

    .txt and .tum hold TUM's format, .kitti KITTI's, .csv a table with a line of names; .g2o is the pose graph of loop, in the world frame.
    With --mount it is the robot's base instead: x ahead, y left, z up. With --format OUT may have any name, such as /dev/stdout.

    \b
      slamcli export-trajectory path.txt --frame level
      slamcli export-trajectory base.txt --frame level --mount 0.1,0,0.3,0,0.2,0
      slamcli export-trajectory monday.txt --recording monday -r runs/house
    """
    from slamcli.evaluation import of_several, run_trajectories
    from slamcli.formats import trajectory as trajectory_file
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Trajectory

    ending = out.suffix.lower() if format_name else check_ending(out, *FORMAT_OF, ".g2o")
    folder = RunDir.find(run)
    if ending == ".g2o":
        is_plain = (stage or "loop") == "loop" and frame == "world" and mount is None and format_name is None
        _export_graph(out, folder, is_plain=is_plain, as_json=as_json)
        return
    format_name = format_name or FORMAT_OF[ending]
    trajectory = run_trajectories.stage_trajectory(folder, stage or run_trajectories.last_stage(folder))
    if sure_only:
        trajectory = run_trajectories.sure_part(folder, trajectory)
    if recording is not None:
        trajectory = of_several.part(folder, recording, trajectory)
    T_wc = told_in(folder, trajectory.T_wc, frame, mount)
    trajectory_file.writer(format_name)(out, Trajectory(stamp=trajectory.stamp, T_wc=T_wc))
    n = len(trajectory.stamp)
    n_frames = run_trajectories.frame_count(folder) if recording is None else of_several.frame_count(folder, recording)
    note = "; a KITTI file has no stamps, so its lines are not frame numbers here" if format_name == "kitti" and n < n_frames else ""
    tell_written(out, as_json, f"{n} poses of {n_frames} frames{note}", poses=n, frames=n_frames, frame=frame, format=format_name)


def _export_graph(out: Path, folder: RunDir, *, is_plain: bool, as_json: bool) -> None:
    from slamcli.errors import SlamError
    from slamcli.files import write_bytes

    if not is_plain:
        raise SlamError(
            f"{out}: a pose graph is loop's, of the camera in the world frame; leave out --stage, --frame, --mount and --format"
        )
    source = folder.stage_path("loop", "posegraph.g2o")
    write_bytes(out, source.read_bytes())
    tell_written(out, as_json, f"{out.stat().st_size} bytes", bytes=out.stat().st_size, frame="world", format="g2o")


out_folder = click.argument("out", type=Target(is_folder=True))
frames_option = click.option(
    "--frames",
    type=click.Choice(["key", "all"]),
    default="key",
    show_default=True,
    help="Frames whose images are written: key frames, or all that have a pose.",
)
images_option = click.option("--images", type=click.Choice(["png", "jpg"]), default="png", show_default=True, help="Format of the images.")


@click.command("export-colmap")
@out_folder
@run_option
@frames_option
@images_option
@click.option("--text", "as_text", is_flag=True, help="Write the model as text instead of binary.")
@json_option
def export_colmap(out: Path, run: str | None, frames: str, images: str, as_text: bool, as_json: bool) -> None:
    """Write a COLMAP model into the new folder OUT: images/ and sparse/0/, in the level frame (z up, metres).

    It holds the landmarks with their tracks. Images are as recorded, with the lens in the camera's parameters; for programs that need
    pinhole images: colmap image_undistorter.

    \b
      slamcli export-colmap colmap
      slamcli export-colmap colmap --frames all --images jpg
    """
    from slamcli.formats import colmap
    from slamcli.runs import posed_images
    from slamcli.runs.run_directory import RunDir

    folder = RunDir.find(run)
    _check_new(out)
    camera, posed = folder.camera("loop"), posed_images.posed_images(folder, frames=frames)
    names = _image_names(posed, images)
    colours = posed_images.PointColours(posed_images.sparse_model(folder, camera, posed, names))
    (out / "sparse" / "0").mkdir(parents=True)
    (out / "images").mkdir()
    _write_pictures(out / "images", folder, posed, names, colours.look)
    model = colours.model()
    (colmap.write_text if as_text else colmap.write_binary)(out / "sparse" / "0", model)
    error = float(model.error.mean()) if len(model.error) else None
    told = "" if error is None else f", mean reprojection error {error:.2f} px"
    figures = {"images": len(names), "points": len(model.xyz), "reprojection_error_px": None if error is None else round(error, 4)}
    tell_written(out, as_json, f"{len(names)} images, {len(model.xyz)} points{told}", frame="level", **figures)


@click.command("export-nerfstudio")
@out_folder
@run_option
@frames_option
@images_option
@json_option
def export_nerfstudio(out: Path, run: str | None, frames: str, images: str, as_json: bool) -> None:
    """Write transforms.json, images, depth and the cloud into the new folder OUT, for nerfstudio and Gaussian splatting.

    Poses are in the level frame (z up, metres); depth is in millimetres; splatting starts from the cloud, sparse_pc.ply.

    \b
      slamcli export-nerfstudio room && ns-train splatfacto --data room
    """
    from slamcli.formats import cloud, nerfstudio
    from slamcli.runs import posed_images
    from slamcli.runs.run_directory import RunDir

    folder = RunDir.find(run)
    _check_new(out)
    camera, posed = folder.camera("loop"), posed_images.posed_images(folder, frames=frames)
    names = [f"images/{name}" for name in _image_names(posed, images)]
    for part in ("images", "depth"):
        (out / part).mkdir(parents=True)
    _write_pictures(out, folder, posed, names, lambda row, rgb: None)
    depth_names = [f"depth/{Path(name).stem}.png" for name in names]
    workers = folder.config().run.workers
    depth = posed_images.write_depth(out, folder.dataset(), camera, posed.frame.tolist(), depth_names, workers=workers)
    xyz, rgb, _ = cloud.read_ply(folder.stage_path("densify", "cloud.ply"))
    cloud.write_ply(out / CLOUD, xyz, rgb)
    nerfstudio.write_transforms(out / "transforms.json", camera, posed.T_lc, image=names, depth=depth, cloud=CLOUD)
    n, n_depth = len(names), sum(map(bool, depth))
    told = f"{n} images, {n_depth} with depth, {len(xyz)} points"
    tell_written(out, as_json, told, images=n, with_depth=n_depth, points=len(xyz), frame="level")


def _check_new(out: Path) -> None:
    from slamcli.errors import SlamError

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SlamError(f"{out}: exists already; name a new folder")


def _image_names(posed: PosedImages, ending: str) -> list[str]:
    return [f"frame_{frame:06d}.{ending}" for frame in posed.frame.tolist()]


def _write_pictures(out: Path, folder: RunDir, posed: PosedImages, names: list[str], look: Callable[[int, np.ndarray], None]) -> None:
    from slamcli import console
    from slamcli.runs import posed_images

    frames = console.progress(posed.frame.tolist(), "images")
    posed_images.write_pictures(out, folder.dataset(), frames, names, workers=folder.config().run.workers, look=look)
