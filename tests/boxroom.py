"""An analytic room: depth images of axis-aligned boxes by the slab test, for tests of ground, grid and planner."""

import numpy as np

from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_noise import DepthNoise

ROOM = ((0.0, 0.0, 0.0), (8.0, 5.0, 2.5))  # walls, floor and ceiling, seen from inside
TABLE, CUPBOARD = ((5.2, 1.6, 0.0), (6.4, 2.4, 0.72)), ((2.0, 4.5, 0.0), (3.2, 5.0, 1.8))
HANGING, LOW = ((4.0, 1.5, 0.3), (4.5, 1.85, 0.9)), ((1.4, 2.0, 0.0), (1.7, 2.5, 0.12))
FURNITURE = (TABLE, CUPBOARD, HANGING, LOW)
READING = DepthNoise(0.0012, 0.0019)  # of a Kinect
KINECT = Camera(160, 120, 147.3, 152.3, 79.5, 59.5)  # 57 x 43 degrees


def look_along(position, yaw, pitch, roll=0.0):
    """Return T_lc (4, 4) of a camera at a level position, heading `yaw`, looking `pitch` down, turned `roll` about its axis [rad]."""
    cos, sin = np.cos, np.sin
    forward = np.array([cos(yaw) * cos(pitch), sin(yaw) * cos(pitch), -sin(pitch)])
    right = np.array([sin(yaw), -cos(yaw), 0.0])
    down = np.cross(forward, right)
    T_lc = np.eye(4)
    T_lc[:3, :3] = np.stack([cos(roll) * right + sin(roll) * down, -sin(roll) * right + cos(roll) * down, forward], axis=1)
    T_lc[:3, 3] = position
    return T_lc


def render(T_lc, camera=KINECT, boxes=FURNITURE, room=ROOM):
    """Cast a ray through every pixel; returns depth (H, W) float32 [m]."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    ray_c = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    ray = ray_c @ T_lc[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = _slabs(T_lc[:3, 3], ray, room)[1] if room is not None else np.full(u.shape, np.inf)
        for box in boxes:
            enter, leave = _slabs(T_lc[:3, 3], ray, box)
            depth = np.where((enter <= leave) & (enter > 0.0), np.minimum(depth, enter), depth)
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)


def _slabs(origin, ray, box):
    low, high = np.array(box[0]), np.array(box[1])
    a, b = (low - origin) / ray, (high - origin) / ray
    return np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)


def kinect_noise(depth, rng, near=0.5, far=4.0):
    """Add axial noise growing with distance, disparity steps of 1/8 px, range limits and lost pixels at depth edges."""
    noisy = depth + rng.normal(size=depth.shape) * (0.0012 + 0.0019 * (depth - 0.4) ** 2)
    disparity = np.round(8.0 * 580.0 * 0.075 / noisy) / 8.0
    noisy = 580.0 * 0.075 / disparity
    jump = np.zeros(depth.shape, dtype=bool)
    jump[:, 1:] |= np.abs(np.diff(depth, axis=1)) > 0.1
    jump[1:, :] |= np.abs(np.diff(depth, axis=0)) > 0.1
    return np.where((noisy >= near) & (noisy <= far) & ~jump, noisy, np.nan).astype(np.float32)


def round_trip(*, height=0.6, pitch=0.25, step=0.15, margin=0.9, turn=0.2):
    """Return T_lc (N, 4, 4) of a drive once around the room, counter-clockwise, turning on the spot in the corners."""
    corners = np.array([[margin, margin], [8 - margin, margin], [8 - margin, 5 - margin], [margin, 5 - margin]])
    poses = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        yaw = np.arctan2(*(b - a)[::-1])
        for t in np.arange(0.0, np.linalg.norm(b - a), step):
            poses.append(look_along([*(a + t * (b - a) / np.linalg.norm(b - a)), height], yaw, pitch))
        for dyaw in np.arange(0.0, np.pi / 2, turn):
            poses.append(look_along([*b, height], yaw + dyaw, pitch))
    return np.stack(poses)


def cells(made, x0, y0, x1, y1):
    """Return the states of a grid's cells whose centres lie in a rectangle [m]."""
    rows, columns = made.state.shape
    y = made.origin[1] + (np.arange(rows) + 0.5) * float(made.resolution)
    x = made.origin[0] + (np.arange(columns) + 0.5) * float(made.resolution)
    return made.state[np.ix_((y > y0) & (y < y1), (x > x0) & (x < x1))]
