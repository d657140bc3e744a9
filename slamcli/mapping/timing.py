"""When a measurement was taken: a rolling shutter reads rows one after another, and depth is taken at another instant than colour.

A hand moves at 0.5 m/s and 1 rad/s. In the 18 ms that a Kinect needs to read its colour image the upper and lower rows part by several
pixels, and a depth image taken 25 ms earlier is off by a centimetre. Both follow from two numbers per camera, the readout time and the
depth delay, and from the camera's own motion; `rectify` takes them out.
"""

from dataclasses import replace

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Map, Timing, Tracks, frame_poses

REACH = 3  # frames on either side from which a frame's motion is read
MAX_GAP = 0.15  # s, between a frame and those: over more the motion is not steady
FAR = 4.0  # m, depth assumed where none was read: there only the rotation moves a pixel noticeably
ROWS_AT_ONCE = 1 << 18  # features rectified together: the intermediate results of a long recording would fill the memory
LARGEST_GAP = 0.2  # [s] between neighbouring frames; over a longer one the motion is anybody's guess


def twists(stamp: np.ndarray, T_wc: np.ndarray) -> np.ndarray:
    """Give each frame's motion (F, 6) [m/s, rad/s] in its own camera frame, by a straight line through the frames around it.

    T_wc : (F, 4, 4), NaN = lost. 0 where fewer than two frames are near enough in time.

    The difference of two neighbours would do for a camera that is tracked without noise. But rectified features make new poses, and
    those new motions: each round would feed the jitter of single frames back to them, larger.
    """
    n, steps = len(stamp), np.arange(-REACH, REACH + 1)
    j = np.arange(n)[:, None] + steps
    inside = (j >= 0) & (j < n)
    j = np.clip(j, 0, n - 1)
    dt = stamp[j] - stamp[:, None]
    has_pose = np.isfinite(T_wc[:, 0, 0])
    use = inside & has_pose[j] & has_pose[:, None] & (np.abs(dt) <= MAX_GAP)
    here, there = np.nonzero(use)
    motion = np.zeros((n, len(steps), 6))
    motion[here, there] = se3.log(se3.inverse(T_wc[here]) @ T_wc[j[here, there]])
    weight = use / np.maximum(use.sum(axis=1, keepdims=True), 1)
    dt = np.where(use, dt - (weight * dt).sum(axis=1, keepdims=True), 0.0)
    spread = (dt * dt).sum(axis=1)
    slope = np.einsum("nk,nki->ni", dt, motion)
    return np.divide(slope, spread[:, None], out=np.zeros((n, 6)), where=spread[:, None] > 0.0)


def frame_twists(stamp: np.ndarray, tracks: Tracks, map_: Map) -> np.ndarray:
    """Give each frame's motion (F, 6) as `twists` does, each map segment for itself."""
    segments = range(int(map_.kf_segment.max(initial=0)) + 1)
    return np.sum([twists(stamp, frame_poses(tracks, map_, segment)) for segment in segments], axis=0)


def velocity(xyz_c: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Give how fast resting points (N, 3) [m, camera] move in a camera that moves by `twist` (N, 6) or (6,); (N, 3) [m/s]."""
    return -(twist[..., :3] + np.cross(twist[..., 3:], xyz_c))


def flow(features: Features, twist: np.ndarray, camera: Camera, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give what the camera's motion does to measurements, per second, and when in the readout they were made.

    Returns pixel velocity (N, 2) [px/s], depth velocity (N,) [m/s] and the share of the readout, -0.5 to 0.5, at which each was read (N,).
    """
    frame = np.searchsorted(features.offset, rows, side="right") - 1
    xy = np.asarray(features.xy[rows], dtype=np.float64)
    depth = np.asarray(features.depth[rows], dtype=np.float64)
    x_c = camera.backproject(xy, np.where(np.isfinite(depth), depth, FAR))
    v = velocity(x_c, twist[frame])
    focal = np.array([camera.fx, camera.fy])
    px_per_s = focal * (v[:, :2] - x_c[:, :2] / x_c[:, 2:] * v[:, 2:]) / x_c[:, 2:]
    return px_per_s, v[:, 2], xy[:, 1] / camera.height - 0.5


def depth_lag(features: Features, timing: Timing) -> np.ndarray:
    """Give by how much each frame's depth was taken later than its colour image, (F,) [s]; 0 where it is not to be moved."""
    return np.nan_to_num(features.depth_stamp - features.stamp + float(timing.depth_delay))


def rectify(features: Features, timing: Timing, camera: Camera) -> Features:
    """Give the features as a camera would have measured them that takes the whole image, and its depth, at the colour stamp."""
    xy, depth, lag = np.array(features.xy), np.array(features.depth), depth_lag(features, timing)
    for start in range(0, len(xy), ROWS_AT_ONCE):
        rows = np.arange(start, min(start + ROWS_AT_ONCE, len(xy)))
        px_per_s, depth_per_s, share = flow(features, timing.twist, camera, rows)
        frame = np.searchsorted(features.offset, rows, side="right") - 1
        xy[rows] -= px_per_s * (share * float(timing.readout))[:, None]
        z = depth[rows] - depth_per_s * lag[frame]
        depth[rows] = np.where(z > 0.0, z, np.nan)
    return replace(features, xy=xy, depth=depth)


def depth_to_colour(features: Features, when: Timing, frames: np.ndarray) -> np.ndarray:
    """Give per frame of `frames` (N,) its camera when depth was measured to its camera when colour was, (N, 4, 4)."""
    later = features.depth_stamp[frames] + float(when.depth_delay) - features.stamp[frames]
    return se3.exp(when.twist[frames] * np.nan_to_num(later)[:, None])


def depth_poses(stamp: np.ndarray, depth_stamp: np.ndarray, T_wc: np.ndarray) -> np.ndarray:
    """Move each frame's pose to the time of its depth image, along the screw motion to the neighbouring frame.

    stamp, depth_stamp : (F,) [s], of the colour images, increasing, and of the depth images, NaN where there is none
    T_wc : (F, 4, 4) camera to world at `stamp`, NaN where unknown
    Returns (F, 4, 4); as given where there is no depth, or no neighbour close in time on the side to which the depth image lies.
    """
    out = np.array(T_wc, dtype=np.float64)
    delay = depth_stamp - stamp
    frame = np.arange(len(stamp))
    other = frame + np.where(delay < 0.0, -1, 1)
    inside = (other >= 0) & (other < len(stamp)) & (np.nan_to_num(delay) != 0.0)
    frame, other = frame[inside], other[inside]
    gap = stamp[other] - stamp[frame]
    usable = (np.abs(gap) < LARGEST_GAP) & (gap != 0.0) & np.isfinite(T_wc[frame, 0, 0]) & np.isfinite(T_wc[other, 0, 0])
    frame, other, gap = frame[usable], other[usable], gap[usable]
    out[frame] = se3.interpolate(T_wc[frame], T_wc[other], delay[frame] / gap)
    return out
