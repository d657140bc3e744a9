"""When a measurement was taken: a rolling shutter reads rows one after another, and depth is taken at another instant than colour.

A hand moves at 0.5 m/s and 1 rad/s. In the 18 ms that a Kinect needs to read its colour image the upper and lower rows part by several
pixels, and a depth image taken 25 ms earlier is off by a centimetre. Both follow from two numbers per camera, the readout time and the
depth delay, and from the camera's own motion; `rectify` takes them out.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import b1, f4, f8, i8

from slamcli import mapped_memory
from slamcli.geometry import se3
from slamcli.geometry.algebra import product, solve
from slamcli.geometry.camera import Camera
from slamcli.jit.kernel import kernel
from slamcli.schema import Features, Map, Timing, Tracks, frame_poses

REACH = 2  # frames on either side from which a frame's motion is read
MAX_GAP = 0.15  # s, between a frame and those: over more the motion is not steady
FAR = 4.0  # m, depth assumed where none was read: there only the rotation moves a pixel noticeably
LARGEST_GAP = 0.2  # [s] between neighbouring frames; over a longer one the motion is anybody's guess


def twists(stamp: np.ndarray, T_wc: np.ndarray) -> np.ndarray:
    """Return each frame's motion (F, 6) [m/s, rad/s] in its own camera frame: the slope of a cubic through the frames around it.

    T_wc : (F, 4, 4), NaN = lost. Where one of these frames is missing a straight line has to do, and 0 where all are.

    A hand shakes at several hertz: a line through more frames is less noisy but misses that (fr1_xyz: 20 % more APE with three on either
    side). The noise of single poses is not fed back to them, larger, by the features that this motion rectifies: a pixel is moved over
    a third of the time between frames at most.
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
    motion[here, there] = se3.log(product(se3.inverse(T_wc[here]), T_wc[j[here, there]]))
    share = dt / MAX_GAP
    powers = np.stack([np.ones_like(share), share, share * share, share * share * share], axis=2) * use[:, :, None]
    powers[~use.all(axis=1), :, 2:] = 0.0
    normal = np.einsum("nki,nkj->nij", powers, powers)
    normal += np.eye(4) * (np.einsum("nii->ni", normal) == 0.0)[:, None, :]
    return solve(normal, np.einsum("nki,nkj->nij", powers, motion))[:, 1] / MAX_GAP


def frame_twists(stamp: np.ndarray, tracks: Tracks, map_: Map) -> np.ndarray:
    """Return each frame's motion (F, 6) as `twists` does, each map segment for itself."""
    segments = range(int(map_.kf_segment.max(initial=0)) + 1)
    return np.sum([twists(stamp, frame_poses(tracks, map_, segment)) for segment in segments], axis=0)


def velocity(xyz_c: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Return how fast resting points (N, 3) [m, camera] move in a camera that moves by `twist` (N, 6) or (6,); (N, 3) [m/s]."""
    return -(twist[..., :3] + np.cross(twist[..., 3:], xyz_c))


@dataclass(frozen=True)
class ImageMotion:
    """What the camera's motion does to measurements."""

    px_per_s: np.ndarray  # (N, 2) px/s, of the points in the image
    reading_per_s: np.ndarray  # (N,) m/s, of depth at a pixel that stays where it is
    slant_per_s: np.ndarray  # (N,) m/s, of depth along the point's way through the image, over its surface held still
    share: np.ndarray  # (N,) -0.5 to 0.5, when in the readout each was measured


def flow(features: Features, twist: np.ndarray, camera: Camera, rows: np.ndarray) -> ImageMotion:
    """Return what the camera's motion `twist` (F, 6) does to the measurements `rows` (N,)."""
    frame = np.searchsorted(features.offset, rows, side="right") - 1
    xy = np.asarray(features.xy[rows], dtype=np.float64)
    depth = np.asarray(features.depth[rows], dtype=np.float64)
    x_c = camera.backproject(xy, np.where(np.isfinite(depth), depth, FAR))
    v = velocity(x_c, twist[frame])
    focal = np.array([camera.fx, camera.fy])
    px_per_s = focal * (v[:, :2] - x_c[:, :2] / x_c[:, 2:] * v[:, 2:]) / x_c[:, 2:]
    slant_per_s = -(x_c[:, 2] ** 2) * (np.asarray(features.slope[rows], dtype=np.float64) * px_per_s).sum(axis=1)
    return ImageMotion(px_per_s, v[:, 2] - slant_per_s, slant_per_s, xy[:, 1] / camera.height - 0.5)


def rectify(features: Features, timing: Timing, camera: Camera) -> Features:
    """Return the features as a camera would have measured them that takes the whole image, and its depth, at the colour stamp.

    A depth image taken later by t was read at the pixel where the point was in the colour image, not where it has gone to since: on a
    slanted surface that is another point. The reading has changed by t times what the point's depth does less what the slant makes of
    the point's way through the image.
    """
    xy, depth = mapped_memory.copy(features.xy), mapped_memory.copy(features.depth)
    offset, twist = np.array(features.offset, dtype=np.int64), np.ascontiguousarray(timing.twist, dtype=np.float64)
    _rectify(
        _Frames(offset, twist, depth_lag(features, timing)),
        np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.height], dtype=np.float64),
        _Shutters(float(timing.readout), float(timing.depth_readout), not np.isnan(timing.depth_delay)),
        _Measured(np.ascontiguousarray(features.slope), xy, depth),
    )
    return replace(features, xy=xy, depth=depth)


class _Frames(NamedTuple):
    """How the camera moved in F frames, and which measurements are of each."""

    offset: i8[::1]  # (F + 1,) rows of each frame
    twist: f8[:, ::1]  # (F, 6) [m/s, rad/s]
    lag: f8[::1]  # (F,) [s] by which depth was taken later than colour


class _Shutters(NamedTuple):
    """How long the two cameras read."""

    readout: float  # [s] of the colour camera
    depth_readout: float  # [s]
    moves_depth: b1  # whether it is known when depth was taken


class _Measured(NamedTuple):
    """N measurements."""

    slope: f4[:, ::1]  # (N, 2), as of `Features`
    xy: f4[:, ::1]  # (N, 2) [px]
    depth: f4[::1]  # (N,) [m], NaN = none


@kernel(error_model="numpy")
def _rectify(frames: _Frames, camera: f8[::1], shutters: _Shutters, measured: _Measured):
    """Move xy and depth in place to what `flow` says of them at the colour stamp; camera : fx, fy, cx, cy, height."""
    offset, twist, lag = frames
    readout, depth_readout, moves_depth = shutters
    slope, xy, depth = measured
    fx, fy, cx, cy, height = camera[0], camera[1], camera[2], camera[3], camera[4]
    for frame in range(len(offset) - 1):
        t0, t1, t2, w0, w1, w2 = twist[frame, 0], twist[frame, 1], twist[frame, 2], twist[frame, 3], twist[frame, 4], twist[frame, 5]
        for row in range(offset[frame], offset[frame + 1]):
            u, v, d = float(xy[row, 0]), float(xy[row, 1]), float(depth[row])
            z = d if np.isfinite(d) else FAR
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            vx, vy, vz = -(t0 + (w1 * z - w2 * y)), -(t1 + (w2 * x - w0 * z)), -(t2 + (w0 * y - w1 * x))
            du, dv = fx * (vx - x / z * vz) / z, fy * (vy - y / z * vz) / z
            share = v / height - 0.5
            xy[row, 0], xy[row, 1] = u - du * (share * readout), v - dv * (share * readout)
            if moves_depth:
                slant = -(z * z) * (float(slope[row, 0]) * du + float(slope[row, 1]) * dv)
                later = d - (vz - slant) * (lag[frame] + share * depth_readout) - slant * (share * readout)
                depth[row] = later if later > 0.0 else np.nan


def depth_lag(features: Features, timing: Timing) -> np.ndarray:
    """Return by how much the middle row of each frame's depth was taken later than its colour image's, (F,) [s]; 0 where it is not to be moved."""
    return np.nan_to_num(features.depth_stamp - features.stamp + float(timing.depth_delay))


def depth_to_colour(features: Features, when: Timing, frames: np.ndarray) -> np.ndarray:
    """Return per frame of `frames` (N,) its camera when depth was measured to its camera when colour was, (N, 4, 4)."""
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
