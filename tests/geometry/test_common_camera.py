"""One camera for the pictures of several: the same directions, and nothing else changes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from slamcli.geometry.camera import EQUIDISTANT, Camera
from slamcli.geometry.common_camera import MOST_PIXELS, Retelling, common_camera, focal_length

WIDE = Camera(200, 150, 130.0, 131.0, 98.0, 77.0, depth_scale=1000.0)
FINE = Camera(160, 120, 210.0, 208.0, 81.0, 58.0, 0.1, -0.2, 0.001, 0.002, 0.05)
FISHEYE = Camera(180, 180, 75.0, 75.0, 90.0, 90.0, 0.01, -0.005, lens=EQUIDISTANT)


def test_cameras_alike_keep_their_pixels_and_their_lens():
    other_unit = replace(FINE, depth_scale=1000.0)
    assert common_camera([FINE, other_unit, FINE]) == FINE
    how = Retelling(other_unit, FINE)
    xy, depth = np.random.default_rng(0).uniform(0, 100, (5, 2)), np.ones((120, 160), np.float32)
    assert how.is_identity and how.pixels(xy) is xy and how.depth(depth) is depth and how.magnification == 1.0


@pytest.mark.parametrize("cameras", [(WIDE, FINE), (FINE, WIDE), (WIDE, FINE, FISHEYE)])
def test_the_common_camera_is_as_fine_as_the_finest_and_sees_what_any_does(cameras):
    common = common_camera(cameras)
    assert not common.is_distorted
    assert common == common_camera(cameras[::-1]) or common.depth_scale != common_camera(cameras[::-1]).depth_scale
    assert focal_length(common) == pytest.approx(focal_length(FINE))
    for camera in {WIDE, FINE} & set(cameras):
        u, v = np.meshgrid([0, camera.width - 1], [0, camera.height - 1])
        direction = camera.normalize(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64))
        xy = direction * focal_length(common) + [common.cx, common.cy]
        assert (xy > -0.5).all() and (xy < [common.width - 0.5, common.height - 0.5]).all()


def test_a_common_camera_is_bounded():
    telescope = Camera(640, 480, 6000.0, 6000.0, 320.0, 240.0)
    common = common_camera([telescope, FISHEYE])
    assert common.width * common.height <= 1.01 * MOST_PIXELS
    assert 0.3 < focal_length(common) / focal_length(FISHEYE) < 10


@pytest.mark.parametrize("own", [WIDE, FINE])
def test_pixels_are_told_with_their_directions(own):
    common = common_camera([WIDE, FINE])
    x_c = np.random.default_rng(1).uniform([-0.3, -0.3, 0.5], [0.3, 0.3, 5.0], (50, 3))
    x_c[:, :2] *= x_c[:, 2:]
    np.testing.assert_allclose(Retelling(own, common).pixels(own.project(x_c)), common.project(x_c), atol=1e-9)


@pytest.mark.parametrize("own", [WIDE, FINE, FISHEYE])
def test_pictures_and_depth_show_the_same_in_the_common_pixels(own):
    """A slanted plane with a smooth picture on it: rendered by the own camera and told, it is what the common camera would render."""
    common = common_camera([WIDE, FINE, FISHEYE])

    def render(camera):
        rays = camera.rays.astype(np.float64)
        depth = 1.0 / (0.5 + 0.05 * rays[..., 0] - 0.02 * rays[..., 1])
        return depth.astype(np.float32), (127 + 100 * np.sin(6 * rays[..., 0]) * np.cos(5 * rays[..., 1])).astype(np.float32)

    how, (depth, picture), (true_depth, true_picture) = Retelling(own, common), render(own), render(common)
    told = how.depth(depth)
    seen = np.isfinite(told)
    assert 0.03 < seen.mean() <= 1.0
    assert np.abs(told - true_depth)[seen].max() < 0.05 and np.median(np.abs(told - true_depth)[seen]) < 0.01
    u, v = cv2.split(how.source)
    shown = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1.0)
    inner = (u > 1) & (v > 1) & (u < own.width - 2) & (v < own.height - 2)
    assert inner.mean() > 0.03
    assert np.abs(shown - true_picture)[inner].max() < 8.0


def test_what_lies_beyond_a_lens_does_not_fold_back_into_its_picture():
    folding = Camera(160, 120, 210.0, 210.0, 80.0, 60.0, -0.9)
    how = Retelling(folding, common_camera([folding, FISHEYE]))
    direction = np.linalg.norm(how.common.rays, axis=2)
    inside = (how.source > -0.5).all(axis=2) & (how.source < [160, 120]).all(axis=2)
    assert inside.any() and direction[inside].max() < 0.75  # the corner of its picture
