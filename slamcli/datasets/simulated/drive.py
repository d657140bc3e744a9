"""Motions through a simulated room: a robot's rounds, or a trajectory recorded elsewhere."""

from dataclasses import dataclass

import numpy as np

from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.schema import Trajectory

DENSE = 4000  # points of a closed path
BRAKE = 1.0  # [s] to come to a rest from full speed, and to leave it again


@dataclass(frozen=True)
class Motion:
    """When each image is taken and where the camera is then (T_lc: camera to level frame)."""

    colour_stamp: np.ndarray  # (F,) [s]
    colour_T_lc: np.ndarray  # (F, 4, 4)
    depth_stamp: np.ndarray  # (F,) [s]
    depth_T_lc: np.ndarray  # (F, 4, 4)


@dataclass(frozen=True)
class Pace:
    """How fast a closed path is driven, and how far."""

    frames: int | None  # images; None = as many as `speed` and `turn_rate` take at `rate`
    speed: float  # [m/s] at most, where `frames` does not say how long it takes
    turn_rate: float  # [rad/s] the same
    rate: float  # [Hz] of images
    laps: float  # rounds, any fraction
    rest: float = 0.0  # [s] of standing still half-way


def closed_path(low: np.ndarray, high: np.ndarray, margin: float, rng: np.random.Generator) -> np.ndarray:
    """Return a smooth closed path (DENSE, 2), `margin` from the walls: a superellipse with slight waves, counter-clockwise."""
    half = (high[:2] - low[:2]) / 2 - margin
    angle = np.linspace(0.0, 2 * np.pi, DENSE, endpoint=False) + rng.uniform(0, 2 * np.pi)
    wave = np.sum([rng.uniform(-0.02, 0.02) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in (2, 3, 5)], axis=0)
    power = 0.55  # 1 an ellipse, 0 a rectangle
    round_ = np.stack(
        [np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** power, np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power], axis=1
    )
    path = (low[:2] + high[:2]) / 2 + half * round_ * (1.0 + wave)[:, None]
    return smoothed(evened(path), 0.04)


def turned(path: np.ndarray, *, start: float, backwards: bool) -> np.ndarray:
    """Return a closed path (N, 2) that begins at a share of its length and may lead the other way."""
    path = np.roll(path, -round(start * len(path)), axis=0)
    return np.roll(path[::-1], 1, axis=0) if backwards else path


def rounds(path: np.ndarray, pace: Pace, *, height: float, pitch: float, rng: np.random.Generator, ahead: float = 0.005) -> Motion:
    """Drive along a closed path.

    height, pitch : of the camera [m], [rad], positive up; the robot rocks by some millimetres and tenths of a degree
    ahead : share of the path on either side over which its direction is taken
    """
    rate = pace.rate
    step = np.roll(path, -1, axis=0) - path
    length = np.linalg.norm(step, axis=1)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    turn = np.abs(np.diff(heading, append=heading[0] + 2 * np.pi * np.round((heading[-1] - heading[0]) / (2 * np.pi))))
    seconds = smoothed(np.hypot(length / pace.speed, turn / pace.turn_rate)[:, None], 0.02)[:, 0]
    clock = np.concatenate([[0.0], np.cumsum(seconds)])  # at each point of the path, over one lap
    total = pace.laps * clock[-1]
    n = pace.frames if pace.frames is not None else max(2, round(total * rate) + 1) + round(pace.rest * rate)
    when = _clock(total, n, rate, pace.rest)
    share = np.interp(when % clock[-1], clock, np.arange(DENSE + 1) / DENSE) + when // clock[-1]
    xy, psi = _at(path, share), _heading_at(path, share, ahead)
    wobble = [_sway(share, rng) for _ in range(5)]
    side = np.stack([-np.sin(psi), np.cos(psi)], axis=1)
    position = np.column_stack([xy + 0.03 * wobble[0][:, None] * side, height + 0.003 * wobble[1]])
    look = psi + 0.12 * np.sin(2 * np.pi * (3 * share + rng.random()))
    T_lc = look_along(position, look + 0.01 * wobble[2], pitch + 0.005 * wobble[3], 0.005 * wobble[4])
    stamp = np.round(np.arange(n) / rate, 6)
    return Motion(stamp, T_lc, stamp, T_lc)


def _clock(total: float, n: int, rate: float, rest: float) -> np.ndarray:
    """Return how much (n,) of a drive of `total` [s] lies behind at each image: evenly more, but for a rest [s] half-way and brakes around it."""
    if rest == 0.0:
        return np.linspace(0.0, total, n)
    between = (np.arange(n - 1) + 0.5 - (n - 1) / 2) / rate  # [s] from the middle of the rest, of each step from image to image
    step = np.clip((np.abs(between) - rest / 2) / BRAKE, 0.0, 1.0)
    way = np.concatenate([[0.0], np.cumsum(step)])
    return total * (way / max(way[-1], 1e-9))


def _sway(share: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return smooth values of about -1..1 that differ from lap to lap."""
    waves = [rng.normal() * np.sin(2 * np.pi * (f * share + rng.random())) / 2 for f in (1.7, 4.3, 11.1)]
    return np.sum(waves, axis=0)


def look_along(position: np.ndarray, heading: np.ndarray, pitch: np.ndarray | float, roll: np.ndarray | float) -> np.ndarray:
    """Return T_lc (N, 4, 4) of cameras at (N, 3) that look along a heading [rad], pitched up and rolled clockwise."""
    heading, pitch, roll = np.broadcast_arrays(heading, pitch, roll)
    forward = np.stack([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)], axis=1)
    right = np.stack([np.sin(heading), -np.cos(heading), np.zeros(len(heading))], axis=1)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    T = np.tile(np.eye(4), (len(heading), 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2], T[:, :3, 3] = c * right + s * down, c * down - s * right, forward, position
    return T


def along(trajectory: Trajectory, stamps: np.ndarray | None, *, rate: float, frames: int | None) -> Motion:
    """Follow a trajectory.

    stamps : (F, 2) colour and depth stamps [s]; None = both at `rate` [Hz] over the whole trajectory
    frames : at most so many; None = all

    Stamps outside the trajectory are left out; an error if none is inside.
    """
    first, last = trajectory.stamp[0], trajectory.stamp[-1]
    if stamps is None:
        even = np.round(np.arange(first, last, 1.0 / rate), 6)
        stamps = np.column_stack([even, even])
    stamps = stamps[((stamps >= first) & (stamps <= last)).all(axis=1)][:frames]
    if len(stamps) == 0:
        raise SlamError(f"no stamp lies within the trajectory, which lasts from {first:.6f} to {last:.6f}")
    colour, depth = np.ascontiguousarray(stamps.T)
    return Motion(colour, interpolate(trajectory, colour), depth, interpolate(trajectory, depth))


def interpolate(trajectory: Trajectory, stamp: np.ndarray) -> np.ndarray:
    """Return the poses (N, 4, 4) at stamps within the trajectory."""
    if len(trajectory.stamp) == 1:
        return np.tile(trajectory.T_wc[0], (len(stamp), 1, 1))
    after = np.searchsorted(trajectory.stamp, stamp).clip(1, len(trajectory.stamp) - 1)
    before = after - 1
    alpha = (stamp - trajectory.stamp[before]) / (trajectory.stamp[after] - trajectory.stamp[before])
    return se3.interpolate(trajectory.T_wc[before], trajectory.T_wc[after], alpha)


def evened(path: np.ndarray) -> np.ndarray:
    """Resample a closed path (N, 2) at even arc length, (DENSE, 2)."""
    closed = np.concatenate([path, path[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.linspace(0.0, arc[-1], DENSE, endpoint=False)
    return np.stack([np.interp(at, arc, closed[:, k]) for k in range(2)], axis=1)


def smoothed(values: np.ndarray, share: float) -> np.ndarray:
    """Smooth a periodic signal (N, k) with a Gaussian whose sigma is a share of the period."""
    n = len(values)
    frequency = np.fft.rfftfreq(n, d=1.0 / n)
    gain = np.exp(-0.5 * (2 * np.pi * frequency * share) ** 2)
    return np.fft.irfft(np.fft.rfft(values, axis=0) * gain[:, None], n=n, axis=0)


def _at(path: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the points (N, 2) at shares of the closed path's length."""
    grid = np.arange(DENSE + 1) / DENSE
    return np.stack([np.interp(share % 1.0, grid, np.append(path[:, k], path[0, k])) for k in range(2)], axis=1)


def _heading_at(path: np.ndarray, share: np.ndarray, ahead: float) -> np.ndarray:
    step = _at(path, share + ahead) - _at(path, share - ahead)
    return np.arctan2(step[:, 1], step[:, 0])
