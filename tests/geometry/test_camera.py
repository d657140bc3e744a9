"""The camera: laws of projection and distortion, OpenCV as oracle, intrinsics that cannot be right."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.errors import SlamError
from slamcli.geometry.camera import Camera

FREIBURG1 = Camera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314)


@given(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(0.2, 20.0))
def test_projection_inverts_backprojection(x, y, z):
    point = np.array([x, y, z])
    xy = FREIBURG1.project(point)
    np.testing.assert_allclose(FREIBURG1.backproject(xy, np.array(z)), point, atol=1e-9)


def test_undistortion_inverts_distortion_all_over_the_image():
    u, v = np.meshgrid(np.linspace(0, 639, 30), np.linspace(0, 479, 30))
    raw = np.stack([u.ravel(), v.ravel()], axis=1)
    np.testing.assert_allclose(FREIBURG1.distort(FREIBURG1.undistort(raw)), raw, atol=1e-9)


def test_pixels_that_no_point_is_mapped_to_stay_numbers():
    """A polynomial that turns back at radius 0.6: what it cannot reach has no inverse, and must not hang or spread NaN."""
    camera = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, -1.0)
    raw = np.array([[319.5, 239.5], [400.0, 300.0], [0.0, 0.0], [639.0, 479.0]])
    undistorted = camera.undistort(raw)
    assert np.isfinite(undistorted).all()
    np.testing.assert_allclose(camera.distort(undistorted[:2]), raw[:2], atol=1e-9)


def test_distortion_agrees_with_opencv():
    rng = np.random.default_rng(0)
    x_c = np.concatenate([rng.uniform(-0.5, 0.5, (50, 2)), np.ones((50, 1))], axis=1)
    coefficients = np.array([FREIBURG1.k1, FREIBURG1.k2, FREIBURG1.p1, FREIBURG1.p2, FREIBURG1.k3])
    expected, _ = cv2.projectPoints(x_c, np.zeros(3), np.zeros(3), FREIBURG1.K, coefficients)
    np.testing.assert_allclose(FREIBURG1.distort(FREIBURG1.project(x_c)), expected[:, 0], atol=1e-9)


def test_rays_lift_a_depth_image():
    camera = Camera(8, 6, 10.0, 11.0, 3.5, 2.5)
    assert camera.rays.shape == (6, 8, 2)
    np.testing.assert_allclose(camera.rays[4, 7], [(7 - 3.5) / 10.0, (4 - 2.5) / 11.0], rtol=1e-6)


def test_dict_round_trip():
    assert Camera.from_dict(FREIBURG1.to_dict(), source="camera.json") == FREIBURG1


@pytest.mark.parametrize(
    "change, message",
    [
        ({"fx": 0.0}, "fx"),
        ({"fx": float("nan")}, "fx"),
        ({"fx": 1e9}, "focal length"),
        ({"cx": -3.0}, "principal point"),
        ({"width": 0}, "width"),
        ({"width": 640.5}, "width"),
        ({"depth_scale": 0.0}, "depth_scale"),
        ({"inverse_depth_offset": 0.2}, "inverse_depth_offset"),
        ({"fx": "517"}, "fx"),
        ({"focal": 3.0}, "'focal' is not known"),
    ],
)
def test_intrinsics_that_cannot_be_right(change, message):
    with pytest.raises(SlamError, match=message) as caught:
        Camera.from_dict(FREIBURG1.to_dict() | change, source="mine.toml")
    assert str(caught.value).startswith("mine.toml")


def test_missing_key():
    values = FREIBURG1.to_dict()
    del values["fy"]
    with pytest.raises(SlamError, match="'fy' is missing"):
        Camera.from_dict(values, source="mine.toml")


def test_depth_readings_become_metres_by_scale_and_offset():
    camera = replace(FREIBURG1, depth_scale=1000.0, inverse_depth_offset=0.01)
    assert np.isnan(camera.metres[0]) and len(camera.metres) == 1 << 16
    np.testing.assert_allclose(camera.metres[[500, 1000, 4000]], [1 / (2.0 + 0.01), 1 / (1.0 + 0.01), 1 / (0.25 + 0.01)], rtol=1e-6)
    behind_infinity = replace(camera, inverse_depth_offset=-0.1).metres
    assert np.isfinite(behind_infinity[9000]) and np.isnan(behind_infinity[11000])


def test_depth_read_under_another_calibration_is_that_of_its_readings():
    given, camera = FREIBURG1, replace(FREIBURG1, depth_scale=4950.0, inverse_depth_offset=-0.004)
    there = camera.reread(given.metres, given)
    np.testing.assert_allclose(there, camera.metres, rtol=1e-5)
    np.testing.assert_allclose(given.reread(there, camera), given.metres, rtol=1e-5)
    assert camera.reread(np.zeros(1, np.float32), given)[0] == 0.0  # no reading stays none
    assert given.reread(there, given) is there


RATIONAL = Camera(1280, 720, 608.0, 607.0, 640.2, 365.1, 0.58, -2.49, 6e-4, -1e-4, 1.36, k4=0.46, k5=-2.33, k6=1.3)  # as of an Azure Kinect
FISHEYE = Camera(848, 800, 286.0, 286.5, 421.0, 399.0, -0.008, 0.047, k3=-0.045, k4=0.008, lens="equidistant")  # as of a T265


@pytest.mark.parametrize("camera", [RATIONAL, FISHEYE], ids=["rational", "equidistant"])
def test_other_lenses_agree_with_opencv_and_are_undone(camera):
    rng = np.random.default_rng(0)
    x_c = np.concatenate([rng.uniform(-0.8, 0.8, (200, 2)), np.ones((200, 1))], axis=1)
    if camera.lens == "equidistant":
        coefficients = camera.coefficients[[0, 1, 4, 5]]
        expected, _ = cv2.fisheye.projectPoints(x_c[:, None], np.zeros(3), np.zeros(3), camera.K, coefficients)
        expected = expected[:, 0]
    else:
        expected = cv2.projectPoints(x_c, np.zeros(3), np.zeros(3), camera.K, camera.coefficients)[0][:, 0]
    raw = camera.distort(camera.project(x_c))
    np.testing.assert_allclose(raw, expected, atol=1e-6)
    np.testing.assert_allclose(camera.undistort(raw), camera.project(x_c), atol=1e-5)


@pytest.mark.parametrize("camera", [RATIONAL, FISHEYE], ids=["rational", "equidistant"])
def test_rays_of_other_lenses_are_numbers_all_over_the_image(camera):
    assert np.isfinite(camera.rays).all()
    assert Camera.from_dict(camera.to_dict(), source="camera.json") == camera


def test_a_camera_file_of_a_plain_lens_keeps_its_keys():
    assert not {"k4", "k5", "k6", "lens"} & FREIBURG1.to_dict().keys()


def test_a_scaled_camera_sees_the_same_rays_in_other_pixels():
    half = FREIBURG1.scaled(320, 240)
    xy = np.array([[100.0, 50.0], [619.0, 460.0]])
    np.testing.assert_allclose(half.normalize((xy + 0.5) / 2 - 0.5), FREIBURG1.normalize(xy), atol=1e-12)
    assert half.scaled(640, 480).to_dict() == pytest.approx(FREIBURG1.to_dict())
    with pytest.raises(SlamError, match="another shape"):
        FREIBURG1.scaled(640, 400)


def test_a_turned_camera_sees_the_same_rays_turned():
    camera = Camera(640, 480, 517.0, 516.0, 318.6, 255.3, 0.2, -0.9)
    turned = camera.turned()
    assert (turned.width, turned.height) == (480, 640)
    x, y = 100.0, 50.0
    np.testing.assert_allclose(
        turned.normalize(np.array([479.0 - y, x])), [-camera.normalize(np.array([x, y]))[1], camera.normalize(np.array([x, y]))[0]]
    )


@pytest.mark.parametrize("kind", ["uint16", "float32"])
def test_readings_become_metres_and_none_where_there_is_none(kind):
    camera = Camera(8, 6, 10.0, 11.0, 3.5, 2.5, depth_scale=1000.0 if kind == "uint16" else 1.0)
    raw = np.array([0, 1500, 65535], np.uint16) if kind == "uint16" else np.array([0.0, 1.5, np.inf], np.float32)
    found = camera.to_metres(raw)
    assert found.dtype == np.float32 and np.isnan(found[[0, 2]]).all() and found[1] == pytest.approx(1.5)
