"""slamcli export-colmap, export-nerfstudio and the endings of export-trajectory."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamcli.formats import cloud, g2o, trajectory
from slamcli.geometry import se3
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Ground, Map


@pytest.fixture(scope="module")
def known(room_run: Path) -> RunDir:
    return RunDir.find(str(room_run))


def test_colmap_reads_the_runs_model_with_its_poses(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    map_, T_lw = known.load(Map, "loop"), known.load(Ground, "densify").T_lw
    for flag in ((), ("--text",)):
        out = tmp_path / f"colmap{len(flag)}"
        result = slamcli("export-colmap", out, "-r", known.path, *flag)
        assert result.exit_code == 0 and "points" in result.stderr
        read = pycolmap.Reconstruction(str(out / "sparse" / "0"))
        assert read.num_images() == len(map_.kf_frame)
        for k, T_wk in enumerate(map_.T_wk):
            image = read.images[k + 1]
            pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
            np.testing.assert_allclose(pose.matrix(), se3.inverse(T_lw @ T_wk)[:3], atol=1e-9)
            assert (out / "images" / image.name).is_file()
        read.update_point_3d_errors()
        assert 0.01 < read.compute_mean_reprojection_error() <= 1.0
        assert len({tuple(point.color) for point in read.points3D.values()}) > 20
        assert all(point.track.length() >= 2 for point in read.points3D.values())
    pictures = list((out / "images").iterdir())
    assert np.array_equal(cv2.imread(str(sorted(pictures)[0]))[..., ::-1], known.dataset().rgb(int(map_.kf_frame[0])))


def test_nerfstudio_gets_opengl_poses_depth_in_millimetres_and_a_cloud(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    out = tmp_path / "nerf"
    result = slamcli("export-nerfstudio", out, "-r", known.path, "--frames", "all", "--images", "jpg")
    assert result.exit_code == 0 and "with depth" in result.stderr
    about = json.loads((out / "transforms.json").read_text())
    camera = known.camera("loop")
    assert (about["w"], about["h"], about["fl_x"], about["cx"]) == (camera.width, camera.height, camera.fx, camera.cx + 0.5)
    assert len(about["frames"]) == 40
    xyz = cloud.read_ply(out / about["ply_file_path"])[0]
    depth = cv2.imread(str(out / about["frames"][0]["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    T = np.array(about["frames"][0]["transform_matrix"])
    z = depth.astype(np.float64) * about["depth_unit_scale_factor"]
    v, u = np.nonzero((z > 0.5) & (z < 3.0))
    # As nerfstudio does it: pixel centres at + 0.5, looking along -z, y up.
    local = np.column_stack([(u + 0.5 - about["cx"]) / about["fl_x"], -(v + 0.5 - about["cy"]) / about["fl_y"], -np.ones(len(u))])
    points = se3.transform(T, local * z[v, u, None])
    from scipy.spatial import KDTree

    assert np.median(KDTree(xyz).query(points[::50])[0]) < 0.02
    assert T[2, 1] > 0.8  # the picture's up is the level frame's up


def test_an_export_never_writes_into_a_folder_that_holds_something(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    for command in ("export-colmap", "export-nerfstudio"):
        result = slamcli(command, tmp_path, "-r", known.path)
        assert result.exit_code == 1 and "name a new folder" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_each_ending_of_a_trajectory_has_its_own_format(slamcli: Callable, known: RunDir, tmp_path: Path) -> None:
    for ending in ("txt", "tum", "csv", "kitti", "g2o"):
        assert slamcli("export-trajectory", tmp_path / f"t.{ending}", "-r", known.path).exit_code == 0
    poses = trajectory.read_tum(tmp_path / "t.txt")
    assert (tmp_path / "t.tum").read_bytes() == (tmp_path / "t.txt").read_bytes()
    table = np.genfromtxt(tmp_path / "t.csv", delimiter=",", names=True)
    assert table.dtype.names == ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
    np.testing.assert_allclose(table["ty"], poses.T_wc[:, 1, 3], atol=1e-9)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "t.kitti").reshape(-1, 3, 4), poses.T_wc[:, :3], atol=1e-8)
    np.testing.assert_allclose(g2o.read_g2o(tmp_path / "t.g2o").T_wk, known.load(Map, "loop").T_wk, atol=1e-9)
    result = slamcli("export-trajectory", tmp_path / "t.g2o", "-r", known.path, "--frame", "level")
    assert result.exit_code == 1 and "pose graph" in result.stderr
    result = slamcli("export-trajectory", tmp_path / "t.xml", "-r", known.path)
    assert result.exit_code == 1 and ".csv" in result.stderr and ".g2o" in result.stderr
    assert slamcli("export-trajectory", tmp_path / "t.xml", "-r", known.path, "--format", "tum").exit_code == 0
    assert (tmp_path / "t.xml").read_bytes() == (tmp_path / "t.txt").read_bytes()
