"""slamcli export-cloud, export-octree, export-mesh."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamcli.cli.common import Target, check_ending, json_option, run_option, tell_written
from slamcli.errors import SlamError

if TYPE_CHECKING:
    from slamcli.runs.run_directory import RunDir

TEXTURED_TRIANGLES = 30_000  # laying more out for a texture takes minutes

out_argument = click.argument("out", type=Target())


@click.command("export-cloud")
@out_argument
@run_option
@click.option("--frame", type=click.Choice(["level", "world"]), default="level", show_default=True, help="level: z up, floor at z = 0.")
@json_option
def export_cloud(out: Path, run: str | None, frame: str, as_json: bool) -> None:
    """Write the coloured cloud to OUT: .ply and .pcd with normals, .las, .laz and .e57 for surveyors' programs.

    \b
      slamcli export-cloud cloud.ply
      slamcli export-cloud cloud.pcd --frame world
      slamcli export-cloud cloud.laz
    """
    from slamcli.formats import cloud
    from slamcli.geometry import se3
    from slamcli.runs.run_directory import RunDir
    from slamcli.schema import Ground

    check_ending(out, *cloud.WRITERS)
    folder = RunDir.find(run)
    xyz, rgb, normal = cloud.read_ply(folder.stage_path("densify", "cloud.ply"))
    if frame == "world":
        T_wl = se3.inverse(folder.load(Ground, "densify").T_lw)
        xyz = se3.transform(T_wl, xyz)
        normal = None if normal is None else normal @ T_wl[:3, :3].T
    cloud.write(out, xyz, rgb, normal)
    tell_written(out, as_json, f"{len(xyz)} points", points=len(xyz), frame=frame, bytes=out.stat().st_size)


@click.command("export-octree")
@out_argument
@run_option
@click.option("--colour", is_flag=True, help="Give occupied leaves the cloud's colours: a ColorOcTree (only .ot).")
@json_option
def export_octree(out: Path, run: str | None, colour: bool, as_json: bool) -> None:
    """Write the octree to OUT for OctoMap and octovis: .bt (free or occupied, small) or .ot (with probabilities).

    \b
      slamcli export-octree map.bt
      slamcli export-octree map.ot --colour
    """
    from slamcli import files
    from slamcli.runs.run_directory import RunDir

    suffix, folder = check_ending(out, ".bt", ".ot"), RunDir.find(run)
    if colour:
        if suffix != ".ot":
            raise SlamError(f"{out}: a .bt file has no room for colours; write a .ot file, or leave out --colour")
        _export_colour_octree(out, folder)
    else:
        with open(folder.stage_path("octree", f"map{suffix}"), "rb") as made, files.whole(out) as file:
            shutil.copyfileobj(made, file)
    tell_written(out, as_json, f"{out.stat().st_size} bytes", bytes=out.stat().st_size, frame="level")


def _export_colour_octree(out: Path, folder: RunDir) -> None:
    from slamcli.formats import cloud, octomap

    xyz, rgb, _ = cloud.read_coloured_ply(folder.stage_path("densify", "cloud.ply"))
    tree = octomap.read(folder.stage_path("octree", "map.ot"))
    octomap.write_colour_ot(out, tree, xyz, rgb, parents=folder.config().octree.parents)


@click.command("export-mesh")
@out_argument
@run_option
@click.option("--voxel", type=click.FloatRange(0.002, 0.5), default=0.02, show_default=True, help="Resolution of the surface [m].")
@click.option(
    "--min-area", type=click.FloatRange(0.0), default=0.01, show_default=True, help="Loose parts smaller than this are left out [m2]."
)
@click.option("--triangles", type=click.IntRange(4), help="Decimate to at most this many.")
@click.option(
    "--even-colours/--raw-colours",
    default=None,
    help="Even out exposure, white balance, vignetting. [default: with --texture, or as densify.even_colours]",
)
@click.option("--texture", is_flag=True, help="Put the images themselves on the surface, not one colour a vertex; .glb and .obj only.")
@click.option("--texture-size", type=click.IntRange(256, 4096), default=2048, show_default=True, help="Side of the texture [texels].")
@json_option
def export_mesh(
    out: Path,
    run: str | None,
    voxel: float,
    min_area: float,
    triangles: int | None,
    even_colours: bool | None,
    texture: bool,
    texture_size: int,
    as_json: bool,
) -> None:
    """Make a coloured triangle mesh of the key frames' depth and write it to OUT: .glb, .obj or .ply.

    It is in the level frame (z up, metres); a .glb file has y up, as its standard asks. With --texture it has at most 30000 triangles,
    unless --triangles says otherwise: the picture shows what they do not, and its colours are evened out. An .obj file then comes with a
    .mtl and a .jpg.

    \b
      slamcli export-mesh room.glb
      slamcli export-mesh room.glb --texture
      slamcli export-mesh fine.ply --voxel 0.01
      slamcli export-mesh light.obj --triangles 50000
    """
    from slamcli.dense import mesh_cleaning
    from slamcli.formats.mesh import TEXTURE_WRITERS, WRITERS
    from slamcli.runs.meshing import RunSurface
    from slamcli.runs.run_directory import RunDir

    suffix = check_ending(out, *WRITERS)
    if texture and suffix not in TEXTURE_WRITERS:
        raise SlamError(f"{out}: a {suffix} file has no texture; write .glb or .obj, or leave out --texture")
    surface = RunSurface(RunDir.find(run), voxel=voxel, even_colours=True if texture and even_colours is None else even_colours)
    mesh = mesh_cleaning.without_islands(surface.mesh(), min_area=min_area)
    if triangles is not None or texture:
        mesh = mesh_cleaning.decimated(mesh, triangles=triangles or TEXTURED_TRIANGLES)
    if not len(mesh.triangle):
        raise SlamError("the mesh is empty: no key frame has depth within densify.depth_max, or every part is smaller than --min-area")
    n, figures = len(mesh.triangle), {"vertices": len(mesh.xyz), "frame": "level"}
    told = f"{n} triangles"
    if texture:
        made, painted = surface.textured(mesh, size=texture_size)
        TEXTURE_WRITERS[suffix](out, mesh.xyz, mesh.triangle, mesh.normal, made.uv, made.picture)
        told += f", {painted:.0%} of the surface painted from images"
        figures["painted"] = round(painted, 4)
    else:
        WRITERS[suffix](out, mesh.xyz, mesh.triangle, mesh.rgb, mesh.normal)
    tell_written(out, as_json, told, triangles=n, bytes=out.stat().st_size, **figures)
