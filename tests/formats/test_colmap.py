"""COLMAP models against pycolmap, COLMAP's own reader."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.formats import colmap
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera

pycolmap = pytest.importorskip("pycolmap")

PLAIN = Camera(640, 480, 520.0, 515.0, 318.6, 255.3)
BENT = replace(PLAIN, k1=0.12, k2=-0.2, p1=-0.004, p2=0.002)
CAMERAS = {
    "PINHOLE": PLAIN,
    "OPENCV": BENT,
    "FULL_OPENCV": replace(BENT, k3=0.1),
    "OPENCV_FISHEYE": replace(PLAIN, k1=0.02, k2=-0.01, k3=0.003, k4=-0.001, lens="equidistant"),
}


def model(camera: Camera, *, seed: int = 0) -> tuple[colmap.SparseModel, np.ndarray]:
    """Points before five cameras, seen exactly; also gives each observation's place in the image."""
    rng = np.random.default_rng(seed)
    T_wc = se3.exp(rng.uniform(-0.2, 0.2, (5, 6)))
    xyz = np.column_stack([rng.uniform(-0.4, 0.4, (40, 2)), rng.uniform(2.0, 3.0, 40)])
    seen = rng.random((40, 5)) < 0.6
    seen[:, :2] = True
    point, image = np.nonzero(seen)
    T_cw = se3.inverse(T_wc)[image]
    xy = camera.distort(camera.project(np.einsum("nij,nj->ni", T_cw[:, :3, :3], xyz[point]) + T_cw[:, :3, 3]))
    rgb = rng.integers(0, 255, (40, 3), dtype=np.uint8)
    names = [f"frame_{k:06d}.png" for k in range(5)]
    return colmap.SparseModel(camera, names, T_wc, xyz, rgb, np.full(40, 0.25), point, image, xy), xy


@pytest.mark.parametrize("write", [colmap.write_text, colmap.write_binary])
@pytest.mark.parametrize("name", CAMERAS)
def test_colmap_reads_the_same_poses_points_and_tracks(write, name: str, tmp_path: Path) -> None:
    given, _ = model(CAMERAS[name])
    assert len(write(tmp_path, given)) == 3
    read = pycolmap.Reconstruction(str(tmp_path))
    assert read.num_images() == 5 and read.num_points3D() == 40
    assert read.cameras[1].model_name == name
    for k in range(5):
        image = read.images[k + 1]
        assert image.name == given.name[k]
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        np.testing.assert_allclose(pose.matrix(), se3.inverse(given.T_wc[k])[:3], atol=1e-9)
    for p in range(40):
        point = read.points3D[p + 1]
        np.testing.assert_allclose(point.xyz, given.xyz[p], atol=1e-12)
        assert np.array_equal(point.color, given.rgb[p])
        ends = {(e.image_id, e.point2D_idx) for e in point.track.elements}
        assert {image for image, _ in ends} == set(given.obs_image[given.obs_point == p] + 1)
        assert all(read.images[image].points2D[row].point3D_id == p + 1 for image, row in ends)


@pytest.mark.parametrize("name", CAMERAS)
def test_colmaps_own_projection_meets_the_key_points(name: str, tmp_path: Path) -> None:
    """Lens parameters, their order, and the half pixel between the two conventions."""
    given, _ = model(CAMERAS[name])
    colmap.write_binary(tmp_path, given)
    read = pycolmap.Reconstruction(str(tmp_path))
    read.update_point_3d_errors()
    assert 0.0 <= read.compute_mean_reprojection_error() < 1e-4


def test_a_lost_image_is_refused(tmp_path: Path) -> None:
    given, _ = model(PLAIN)
    lost = given.T_wc.copy()
    lost[2] = np.nan
    with pytest.raises(SlamError, match="no pose"):
        colmap.write_text(tmp_path, replace(given, T_wc=lost))
    assert not list(tmp_path.glob("images*"))


def test_a_model_without_points_can_be_read(tmp_path: Path) -> None:
    given, _ = model(PLAIN)
    nothing = np.zeros(0, np.int64)
    bare = replace(given, xyz=np.zeros((0, 3)), rgb=np.zeros((0, 3), np.uint8), error=np.zeros(0), obs_point=nothing, obs_image=nothing, obs_xy=np.zeros((0, 2)))  # fmt: skip
    for write in (colmap.write_text, colmap.write_binary):
        folder = tmp_path / write.__name__
        folder.mkdir()
        write(folder, bare)
        assert pycolmap.Reconstruction(str(folder)).num_images() == 5
