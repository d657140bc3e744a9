"""Exports and pictures, from a run whose densify and octree are small and known."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from slamcli.dense.occupancy import OccupancyMap
from slamcli.formats import cloud, octomap
from slamcli.geometry import se3
from slamcli.geometry.octree import prune
from slamcli.navigation.floor_plan import FloorPlan
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Ground


@pytest.fixture(scope="module")
def known(room_run: Path) -> RunDir:
    return RunDir.find(str(room_run))


def test_export_cloud_gives_the_stages_points_in_either_frame_and_format(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    xyz, rgb, normal = cloud.read(known.stage_path("densify", "cloud.ply"))
    T_lw = known.load(Ground, "densify").T_lw
    for name in ("cloud.ply", "cloud.pcd"):
        for frame, T in (("level", np.eye(4)), ("world", se3.inverse(T_lw))):
            result = slamcli("export-cloud", tmp_path / name, "-r", known.path, "--frame", frame)
            assert result.exit_code == 0 and f"{len(xyz)} points" in result.stderr
            found = cloud.read(tmp_path / name)
            np.testing.assert_allclose(found[0], se3.transform(T, xyz.astype(float)), atol=1e-5)
            assert np.array_equal(found[1], rgb)
            np.testing.assert_allclose(found[2], normal @ T[:3, :3].T, atol=1e-5)


@pytest.mark.parametrize("suffix", ["bt", "ot"])
def test_export_octree_gives_the_stages_file(slamcli: Callable, known: RunDir, suffix: str, tmp_path: Path) -> None:
    out = tmp_path / f"my.{suffix}"
    assert slamcli("export-octree", out, "-r", known.path).exit_code == 0
    assert out.read_bytes() == known.stage_path("octree", f"map.{suffix}").read_bytes()
    assert len(octomap.read(out)) > 100


def test_export_octree_with_colours_is_the_same_tree(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    assert slamcli("export-octree", tmp_path / "map.ot", "-r", known.path, "--colour").exit_code == 0
    assert b"id ColorOcTree" in (tmp_path / "map.ot").read_bytes()[:300]
    ours, plain = octomap.read(tmp_path / "map.ot"), octomap.read(known.stage_path("octree", "map.ot"))
    assert np.array_equal(ours.key, plain.key) and np.array_equal(ours.log_odds, plain.log_odds)


def test_export_mesh_makes_a_surface_of_the_level_frame(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    result = slamcli("export-mesh", tmp_path / "mesh.ply", "-r", known.path, "--voxel", 0.05)
    assert result.exit_code == 0 and "triangles" in result.stderr
    mesh, points = cloud.read(tmp_path / "mesh.ply")[0], cloud.read(known.stage_path("densify", "cloud.ply"))[0]
    assert np.median(KDTree(mesh).query(points)[0]) < 0.04


def test_a_mesh_of_fewer_triangles_is_the_same_surface(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    options = ("-r", known.path, "--voxel", 0.05)
    for name, more in (
        ("all.ply", ()),
        ("few.ply", ("--triangles", 2000)),
        ("few.glb", ("--triangles", 2000)),
        ("few.obj", ("--triangles", 2000)),
    ):
        assert slamcli("export-mesh", tmp_path / name, *options, *more).exit_code == 0
    whole, few = (trimesh.load(tmp_path / name, process=False) for name in ("all.ply", "few.ply"))
    assert 1000 < len(few.faces) <= 2000 < len(whole.faces)
    assert few.area == pytest.approx(whole.area, rel=0.1)
    for name in ("few.glb", "few.obj"):
        read = trimesh.load(tmp_path / name, process=False)
        read = read.to_geometry() if isinstance(read, trimesh.Scene) else read
        assert len(read.faces) == len(few.faces) and read.area == pytest.approx(few.area, rel=1e-3)
    result = slamcli("export-mesh", tmp_path / "none.ply", *options, "--min-area", 1e6)
    assert result.exit_code == 1 and "--min-area" in result.stderr


def test_a_textured_mesh_shows_what_the_cloud_shows(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    options = ("-r", known.path, "--voxel", 0.05, "--triangles", 800, "--texture", "--texture-size", 512)
    xyz, rgb, _ = cloud.read_coloured_ply(known.stage_path("densify", "cloud.ply"))
    for name, axes, sign in (("room.glb", [0, 2, 1], [1, -1, 1]), ("room.obj", [0, 1, 2], [1, 1, 1])):
        result = slamcli("export-mesh", tmp_path / name, *options)
        assert result.exit_code == 0 and "painted from images" in result.stderr
        read = trimesh.load(tmp_path / name, process=False, force="mesh")
        places, face = trimesh.sample.sample_surface(read, 2000, seed=0)
        share = trimesh.triangles.points_to_barycentric(read.triangles[face], places)
        uv = np.einsum("nk,nkd->nd", share, read.visual.uv[read.faces[face]])
        seen = trimesh.visual.color.uv_to_color(uv, _picture(read.visual.material))
        distance, row = KDTree(xyz).query(places[:, axes] * sign)
        off = np.abs(seen[:, :3].astype(float) - rgb[row])[distance < 0.04]
        assert len(off) > 800 and 0.0 < np.median(off) < 20
    assert {"room.mtl", "room.jpg"} <= {path.name for path in tmp_path.iterdir()}
    result = slamcli("export-mesh", tmp_path / "room.ply", *options)
    assert result.exit_code == 1 and "has no texture" in result.stderr and not (tmp_path / "room.ply").exists()


def _picture(material: Any) -> Any:
    return getattr(material, "baseColorTexture", None) or material.image


@pytest.mark.parametrize("what", ["cloud", "octree"])
def test_render_draws_the_map(slamcli: Callable, known: RunDir, what: str, tmp_path: Path) -> None:
    out = tmp_path / "picture.png"
    assert slamcli("render", out, "-r", known.path, "--what", what, "--size", 320, 200, "--path").exit_code == 0
    image = cv2.imread(str(out))
    assert image.shape == (200, 320, 3)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (("export-cloud", "cloud.xyz"), "must end in .ply or .pcd or .las or .laz or .e57"),
        (("export-octree", "map.png"), "must end in .bt or .ot"),
        (("export-octree", "map.bt", "--colour"), "no room for colours"),
        (("export-mesh", "mesh.stl"), "must end in .glb or .obj or .ply"),
        (("render", "picture.gif"), "must end in .png or .jpg"),
        (("export-octree", "no/such/folder/map.bt"), "its folder is not there"),
    ],
)
def test_what_cannot_be_written_is_said_in_one_line(slamcli: Callable, known: RunDir, here: Path, command: tuple, message: str) -> None:
    result = slamcli(*command, "-r", known.path)
    assert result.exit_code == 1
    assert message in result.stderr and len(result.stderr.strip().split("\n")) == 1


def test_a_run_without_the_stage_says_what_to_do(slamcli: Callable, here: Path, room: Path) -> None:
    run = here / "run"
    RunDir.create(run, dataset="room", root=str(room), digest="sha256:0")
    for command in (("export-cloud", "a.ply"), ("export-octree", "a.bt"), ("render", "a.png")):
        result = slamcli(*command, "-r", run)
        assert result.exit_code == 1 and "slamcli run --until" in result.stderr


def test_a_run_with_an_empty_map_can_be_exported_but_not_drawn(tmp_path: Path) -> None:
    from slamcli.errors import SlamError
    from slamcli.visualization import render

    empty = prune(OccupancyMap(0.05, hit=0.7, miss=0.4, clamp_min=0.1, clamp_max=0.9).leaves())
    octomap.write_bt(tmp_path / "map.bt", empty)
    with pytest.raises(SlamError, match="nothing to draw"):
        render.draw_octree(octomap.read(tmp_path / "map.bt"), view=render.Viewpoint())


def test_a_floor_plan_is_written_and_told(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    result = slamcli("export-plan", tmp_path / "plan.json", "-r", known.path, "--wall-height", "9", "--json")
    assert result.exit_code == 0
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert {"out": str(tmp_path / "plan.json"), **plan} == json.loads(result.stdout) and plan["walls"] == []
    assert "0 walls, 0 rooms, 0 doors" in result.stderr and "no wall was seen up to 9 m" in result.stderr
    assert slamcli("export-plan", tmp_path / "plan.png", "-r", known.path).exit_code == 1


def test_a_floor_plan_counts_in_words_and_tells_the_areas_that_are_drawn(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    corners = [[0.0, 0.0], [8.0, 0.0], [8.0, 5.0], [0.0, 5.0]]
    wall = {"from": corners[0], "to": corners[1], "length_m": 8.0, "height_m": 2.1}
    room = {"room": 1, "area_m2": 39.95, "middle": [4.0, 2.5], "outline": corners}
    about = {"frame": "level: x, y [m]", "walls": [wall, wall], "rooms": [room], "doors": []}
    with patch.object(FloorPlan, "to_dict", lambda _: about):
        told = slamcli("export-plan", tmp_path / "plan.svg", "-r", known.path).stderr
    area = f"{39.95:.1f}"
    assert f": 2 walls, 1 room ({area} m2), 0 doors" in told and f"1: {area} m²" in (tmp_path / "plan.svg").read_text()


def test_plans_and_films_are_rendered(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    plan = slamcli("render", tmp_path / "plan.png", "--what", "plan", "--size", "160", "120", "--path", "-r", known.path)
    assert plan.exit_code == 0 and "px a metre" in plan.stderr
    height, width = cv2.imread(str(tmp_path / "plan.png")).shape[:2]
    assert width <= 160 and height <= 120 and (width > 150 or height > 110)
    refused = slamcli("render", tmp_path / "map.mp4", "--what", "octree", "-r", known.path)
    assert refused.exit_code == 1 and "only the cloud is filmed" in refused.stderr
    pytest.importorskip("av")
    for tour in ("around", "along"):
        film = slamcli("render", tmp_path / "film.mp4", "--tour", tour, "--seconds", "0.1", "--size", "65", "49", "-r", known.path)
        assert film.exit_code == 0 and "3 frames of 64 x 48 px" in film.stderr


def test_what_flies_gets_a_path_through_the_octree(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    result = slamcli(
        "plan", "--flying", "--start", "first", "--goal", "last", "--radius", "0.1", "-o", tmp_path / "p.json", "-r", known.path
    )
    assert result.exit_code == 0, result.stderr
    rows = np.array([line.split(",") for line in result.stdout.splitlines()[1:]], dtype=float)
    assert result.stdout.startswith("x,y,z,clearance\n") and rows.shape[1] == 4 and (rows[:, 3] >= 0.0).all()
    assert json.loads((tmp_path / "p.json").read_text())["points"] == rows[:, :3].tolist()
    assert slamcli("plan", "--flying", "--start", "1,2", "--goal", "last", "-r", known.path).exit_code == 2
    assert slamcli("plan", "--start", "1,2,3", "--goal", "last", "-r", known.path).exit_code == 2
    assert slamcli("plan", "--flying", "--reachable", "--start", "first", "-r", known.path).exit_code == 2
