"""What a map says of the place of a depth camera: what was put in wrong is found, within its sigma."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, Scene, observe, orbit, room_points
from test_self_calibration import SENSOR, build, moving

from slamcli.calibration import registration
from slamcli.calibration.self_calibration import Sensing
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_registration import Registration
from slamcli.sparse_map import map_adjustment

DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
OFF = np.array([0.0, 0.0, 0.0, 2e-3, -1e-3, 1e-3, 3e-3, -2e-3, 0.0])  # turn [rad] and offset [m] that were put in wrong


def place(turn: np.ndarray, offset: np.ndarray) -> Registration:
    T_cd = se3.exp(np.concatenate([np.zeros(3), turn]))
    T_cd[:3, 3] = offset
    return Registration(DEPTH_CAMERA, CAMERA, T_cd)


def plane_depth(given: Registration, normal: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return what is read of the plane normal . x = 1, which the true depth camera at colour's place sees, where `given` puts it."""
    R, t = given.T_cd[:3, :3], given.T_cd[:3, 3]
    moved = R @ normal / (1.0 + (R @ normal) @ t)  # x_c = R x_d + t: the plane as it was put
    ray = np.stack([(xy[:, 0] - CAMERA.cx) / CAMERA.fx, (xy[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(len(xy))], axis=1)
    return 1.0 / (ray @ moved)


@pytest.mark.parametrize("unknown", range(3, 9))
def test_depth_grows_as_it_does_when_the_depth_camera_is_moved(unknown: int) -> None:
    normal, step = np.array([0.1, 0.35, 0.3]), 1e-5
    xy = np.random.default_rng(unknown).uniform([50, 50], [590, 430], (40, 2))
    change = np.zeros(9)
    change[unknown] = step
    still, there = place(np.zeros(3), np.zeros(3)), place(change[3:6], change[6:9])
    depth = plane_depth(still, normal, xy)
    slope = np.broadcast_to(normal[:2] / [CAMERA.fx, CAMERA.fy], (40, 2))
    found = registration.depth_derivatives(CAMERA.backproject(xy, depth), slope, CAMERA, still)[:, unknown]
    np.testing.assert_allclose(found, (plane_depth(there, normal, xy) - depth) / step, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("unknown", range(3))
def test_a_lens_that_is_put_wrong_moves_readings_aside(unknown: int) -> None:
    """Of a plane that slants along x and y alike, the pixel where each reading belongs is known."""
    normal, step = np.array([0.1, 0.35, 0.3]), (1e-5, 0.01, 0.01)[unknown]
    xy = np.random.default_rng(unknown).uniform([50, 50], [590, 430], (40, 2))
    given = Registration(replace(DEPTH_CAMERA, fx=CAMERA.fx, fy=CAMERA.fy, cx=CAMERA.cx, cy=CAMERA.cy), CAMERA, np.eye(4))
    slope = np.broadcast_to(normal[:2] / [CAMERA.fx, CAMERA.fy], (40, 2))

    def read(xy: np.ndarray) -> np.ndarray:
        return plane_depth(place(np.zeros(3), np.zeros(3)), normal, xy)

    centre = np.array([CAMERA.cx, CAMERA.cy])
    # A depth pixel q shows up at p: with a larger focal length nearer to the middle, with a principal point to the right further to the left.
    q = centre + (xy - centre) * np.exp(step) if unknown == 0 else xy + step * np.eye(2)[unknown - 1]
    found = registration.depth_derivatives(CAMERA.backproject(xy, read(xy)), slope, CAMERA, given)[:, unknown]
    np.testing.assert_allclose(found, (read(q) - read(xy)) / step, rtol=5e-3, atol=1e-5)


def scene() -> Scene:
    """Look at a room from a path that turns, at landmarks on surfaces that slant as floors and walls do."""
    rng = np.random.default_rng(3)
    made = observe(orbit(40, turns=0.2), room_points(2500, rng), rng, per_frame=400)
    slope = rng.normal(0.0, 8e-4, (len(made.landmark), 2)).astype(np.float32)
    return replace(made, features=replace(made.features, slope=slope))


def test_a_map_tells_how_its_depth_camera_was_put_wrong() -> None:
    made, given = scene(), place(np.zeros(3), np.zeros(3))
    features, x_c = made.features, CAMERA.backproject(np.asarray(made.features.xy, float), np.asarray(made.features.depth, float))
    off = registration.depth_derivatives(x_c, np.asarray(features.slope, float), CAMERA, given) @ OFF
    sparse_map, now = build(made, replace(features, depth=(features.depth + off).astype(np.float32))), Sensing(CAMERA, moving(made), {})
    map_adjustment.adjust(sparse_map, np.arange(len(sparse_map.kf), dtype=np.int32), CAMERA, SENSOR, max_iterations=30)
    found = registration.evidence(sparse_map, now, SENSOR, given)
    believed = np.diag(1.0 / np.array([1e-3, 1.0, 1.0, 0.05, 0.05, 0.05, 0.05, 0.05, 1e-3]) ** 2)
    both = found.information + believed
    value, sigma = np.linalg.solve(both, found.pull), np.sqrt(np.diag(np.linalg.inv(both)))
    tells = np.array([3, 4, 5, 6, 7])
    assert (np.abs(value + OFF)[tells] < 3.0 * sigma[tells]).all() and (sigma[tells] < [1e-3, 2e-3, 1e-3, 2e-3, 2e-3]).all()


def test_a_map_without_landmarks_tells_nothing() -> None:
    made = scene()
    sparse_map = build(made, made.features)
    sparse_map.lm_of_row[:] = -1
    assert registration.evidence(sparse_map, Sensing(CAMERA, moving(made), {}), SENSOR, place(np.zeros(3), np.zeros(3))) is None
