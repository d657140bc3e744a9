"""Where a robot stands on the floor, given where its camera is.

ROS's axes: a robot's base and a camera's body have x ahead, y to the left, z up; the camera's optical frame has x right, y down, z ahead.
"""

from collections.abc import Sequence

import numpy as np

from slamcli.geometry import elementary, se3
from slamcli.geometry.algebra import product

LOOKS_DOWN = 0.2  # horizontal part of a view below which the picture's upper edge tells the heading, as in the level frame's definition
OPTICAL_IN_BODY = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def planar_pose(T_lc: np.ndarray) -> tuple[float, float, float]:
    """Return x [m], y [m] and heading [rad] on the floor of a camera pose (4, 4), optical frame to level frame."""
    ahead = T_lc[:2, 2] if np.linalg.norm(T_lc[:2, 2], axis=-1) >= LOOKS_DOWN else -T_lc[:2, 1]
    return float(T_lc[0, 3]), float(T_lc[1, 3]), float(elementary.arctan2(ahead[1], ahead[0]))


def base_in_camera(mount: Sequence[float]) -> np.ndarray:
    """Return T_cb (4, 4), base to the camera's optical frame, of a camera mounted on a robot.

    mount : x, y, z [m], roll, pitch, yaw [rad] of the camera's body in the base, as in a URDF's `<origin xyz rpy>`: the rotation is
        about the fixed axes x, then y, then z
    """
    x, y, z, roll, pitch, yaw = mount
    T_b_body = np.eye(4)
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        twist = np.zeros(6)
        twist[3 + axis] = angle
        T_b_body = product(T_b_body, se3.exp(twist))
    T_b_body[:3, 3] = x, y, z
    return se3.inverse(product(T_b_body, OPTICAL_IN_BODY))


def upright_mount(T_lc: np.ndarray, mount: Sequence[float]) -> tuple[float, ...]:
    """Correct a mount's z, roll and pitch so that the base stands upright on the floor where the camera is at T_lc (4, 4)."""
    R_l_body = product(T_lc, se3.inverse(OPTICAL_IN_BODY))[:3, :3]
    roll = elementary.arctan2(R_l_body[2, 1], R_l_body[2, 2])
    pitch = elementary.arctan2(-R_l_body[2, 0], np.sqrt(R_l_body[2, 1] ** 2 + R_l_body[2, 2] ** 2))
    x, y, _, _, _, yaw = mount
    return x, y, float(T_lc[2, 3]), float(roll), float(pitch), yaw


def base_pose(T_lc: np.ndarray, T_cb: np.ndarray) -> tuple[float, float, float]:
    """Return x [m], y [m] and heading [rad] on the floor of a robot's base, T_cb (4, 4) base to camera."""
    T_lb = product(T_lc, T_cb)
    return float(T_lb[0, 3]), float(T_lb[1, 3]), float(elementary.arctan2(T_lb[1, 0], T_lb[0, 0]))


def base_off_floor(T_lc: np.ndarray, T_cb: np.ndarray) -> tuple[float, float]:
    """Return height above the floor [m] and tilt [rad] of a robot's base, T_cb (4, 4) base to camera: both small where the mount is right."""
    T_lb = product(T_lc, T_cb)
    lean = np.linalg.norm(T_lb[:2, 2], axis=-1)
    return float(T_lb[2, 3]), float(elementary.arctan2(lean, T_lb[2, 2]))
