"""Poses on the floor: of a camera by its view, of a robot by where its camera is mounted."""

import numpy as np
import pytest
from boxroom import look_along
from hypothesis import given
from hypothesis import strategies as st

from slamcli.navigation.floor import level_frame
from slamcli.navigation.robot_pose import base_in_camera, base_off_floor, base_pose, planar_pose, upright_mount

ANGLE = st.floats(-3.0, 3.0)


@given(st.floats(-9, 9), st.floats(-9, 9), ANGLE, st.floats(-1.3, 1.3), st.floats(-0.5, 0.5))
def test_the_heading_is_where_the_camera_looks_however_it_is_tilted(x: float, y: float, yaw: float, pitch: float, roll: float) -> None:
    assert planar_pose(look_along([x, y, 1.0], yaw, pitch, roll)) == pytest.approx((x, y, yaw))


def test_a_camera_that_looks_straight_down_heads_where_its_upper_edge_points() -> None:
    assert planar_pose(look_along([0.0, 0.0, 1.0], 0.7, np.pi / 2 - 0.01))[2] == pytest.approx(0.7)


@given(ANGLE, st.floats(-1.5, 1.5), st.floats(-0.5, 0.5))
def test_the_camera_that_the_level_frame_is_below_stands_at_its_origin(yaw: float, pitch: float, roll: float) -> None:
    T_wc = look_along([3.0, -2.0, 1.4], yaw, pitch, roll)
    T_lw = level_frame(np.array([0.0, 0.0, 1.0, 0.0]), T_wc)
    assert planar_pose(T_lw @ T_wc) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_a_mount_is_read_as_a_urdf_origin() -> None:
    """0.2 m ahead of the base, 0.3 m up, looking 0.5 rad down: what is 1 m ahead of the base lies right and below in the picture."""
    T_cb = base_in_camera((0.2, 0.0, 0.3, 0.0, 0.0, 0.0))
    assert T_cb @ [1.2, 0.1, 0.3, 1.0] == pytest.approx([-0.1, 0.0, 1.0, 1.0])  # left of the axis, 1 m before the lens
    down = base_in_camera((0.0, 0.0, 0.0, 0.0, 0.5, 0.0))
    assert down @ [np.cos(0.5), 0.0, -np.sin(0.5), 1.0] == pytest.approx([0.0, 0.0, 1.0, 1.0])
    left = base_in_camera((0.0, 0.0, 0.0, 0.0, 0.0, 0.5))
    assert left @ [np.cos(0.5), np.sin(0.5), 0.0, 1.0] == pytest.approx([0.0, 0.0, 1.0, 1.0])


@given(st.tuples(*[st.floats(-1, 1)] * 2, st.floats(0.1, 1), *[st.floats(-0.6, 0.6)] * 2, ANGLE), ANGLE, st.floats(-5, 5), st.floats(-5, 5))
def test_the_base_is_found_from_its_camera(mount: tuple, yaw: float, x: float, y: float) -> None:
    T_lb = np.array([[np.cos(yaw), -np.sin(yaw), 0, x], [np.sin(yaw), np.cos(yaw), 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])
    T_cb = base_in_camera(mount)
    assert base_pose(T_lb @ np.linalg.inv(T_cb), T_cb) == pytest.approx((x, y, yaw), abs=1e-9)


@given(ANGLE, st.floats(-1.2, 1.2), st.floats(-0.5, 0.5), st.tuples(*[st.floats(-1, 1)] * 5, ANGLE))
def test_a_corrected_mount_puts_the_base_upright_on_the_floor(yaw: float, pitch: float, roll: float, mount: tuple) -> None:
    T_lc = look_along([2.0, -1.0, 0.7], yaw, pitch, roll)
    upright = upright_mount(T_lc, mount)
    assert base_off_floor(T_lc, base_in_camera(upright)) == pytest.approx((0.0, 0.0), abs=1e-7)
    assert (upright[0], upright[1], upright[5]) == (mount[0], mount[1], mount[5])
