"""A bumper in view: found where it is, nothing else taken for one, and no trail of it in the grid."""

import numpy as np
import pytest
from boxroom import KINECT, kinect_noise, look_along, render, round_trip

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.errors import SlamError
from slamcli.formats.mask import read_mask
from slamcli.navigation import own_body
from slamcli.navigation.grid import FREE, OCCUPIED, build_grid

SETTINGS = GridConfig(stride=1, min_range=0.5, n_low=3, n_high=8)
BUMPER = (slice(104, 120), slice(50, 110))  # rows and columns


def images(T_lc, *, with_bumper):
    rng = np.random.default_rng(0)
    made = []
    for T in T_lc:
        depth = render(T)
        if with_bumper:
            depth[BUMPER] = 0.6
        made.append(kinect_noise(depth, rng))
    return np.stack(made)


def heights(depth, T_lc):
    slope = np.einsum("nk,vuk->nvu", T_lc[:, 2, :2], KINECT.rays.astype(np.float64)) + T_lc[:, 2, 2, None, None]
    return T_lc[:, 2, 3, None, None] + depth * slope


@pytest.fixture(scope="module")
def drive():
    return round_trip(step=0.4, turn=0.4)


def test_the_bumper_is_found_and_nothing_else(drive):
    depth = images(drive, with_bumper=True)
    found = own_body.fixed_parts(depth, heights(depth, drive), drive, band_low=0.05)
    expected = np.zeros((120, 160), bool)
    expected[BUMPER] = True
    assert found[105:119, 51:109].all() and not found[~expected].any()
    bare = images(drive, with_bumper=False)
    assert not own_body.fixed_parts(bare, heights(bare, drive), drive, band_low=0.05).any()


def test_a_straight_drive_along_a_wall_tells_nothing():
    T = np.stack([look_along([1.0 + 0.1 * k, 0.6, 0.6], 0.3, 0.25) for k in range(30)])
    depth = np.tile(images(T[:1], with_bumper=True), (30, 1, 1))
    assert not own_body.fixed_parts(depth, heights(depth, T), T, band_low=0.05).any()


def test_the_floor_before_a_camera_on_wheels_is_no_part_of_the_robot(drive):
    depth = np.full((len(drive), 120, 160), np.nan)
    rows = slice(110, 120)
    depth[:, rows] = (0.6 / -(KINECT.rays[rows] @ drive[0][2, :2] + drive[0][2, 2]))[None]
    found = own_body.fixed_parts(depth, heights(depth, drive), drive, band_low=0.05)
    assert np.nanmin(depth) < own_body.FARTHEST and not found.any()


def test_without_the_bumpers_pixels_no_trail_of_it_is_left(drive):
    depth = images(drive, with_bumper=True)
    body = own_body.fixed_parts(depth, heights(depth, drive), drive, band_low=0.05)
    blocks = body[: 120 // 8 * 8, : 160 // 8 * 8].reshape(15, 8, 20, 8).any(axis=(1, 3))
    is_left_out = own_body.to_pixels(blocks, (120, 160))
    assert is_left_out[BUMPER].all() and is_left_out.mean() < 0.2
    cut = np.where(is_left_out, np.float32(np.nan), depth)
    clean = images(drive, with_bumper=False)
    grids = [build_grid(zip(z, drive, strict=True), KINECT, settings=SETTINGS, sensor=SensorConfig()) for z in (depth, cut, clean)]
    trail, mended, true = ((grid.state == OCCUPIED).sum() for grid in grids)
    assert trail >= true + 15 and abs(mended - true) <= 5
    assert (grids[1].state == FREE).sum() > 0.95 * (grids[2].state == FREE).sum()


def test_a_mask_that_is_no_picture_or_of_another_size_is_an_error(tmp_path):
    import cv2

    path = tmp_path / "mask.png"
    for content, words in ((b"", "not a picture"), (b"no picture", "not a picture")):
        path.write_bytes(content)
        with pytest.raises(SlamError, match=words):
            read_mask(path, (120, 160))
    cv2.imwrite(str(path), np.eye(100, dtype=np.uint8) * 255)
    with pytest.raises(SlamError, match="100 x 100 px"):
        read_mask(path, (120, 160))
    assert read_mask(path, (100, 100)).sum() == 100
    with pytest.raises(SlamError, match="cannot be read"):
        read_mask(tmp_path / "none.png", (1, 1))
