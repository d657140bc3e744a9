"""Simulated landmarks seen along a path: features, words and matches without any image, with the truth at hand."""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Matches, Words
from slamcli.slam.recording import TrackingInput
from slamcli.sparse_map.frame import FrameStore

CAMERA = Camera(640, 480, 520.0, 520.0, 320.0, 240.0)
OCTAVE_SCALE = 1.2
RATE = 30.0  # frames per second


@dataclass(frozen=True)
class Scene:
    """What the pipeline sees, and the truth."""

    features: Features
    words: Words
    matches: Matches
    T_gc: np.ndarray  # (F, 4, 4) camera to world, true
    landmark: np.ndarray  # (M,) true landmark of each feature row
    xyz: np.ndarray  # (L, 3) true landmarks

    def frames(self, sensor: SensorConfig) -> FrameStore:
        return FrameStore(self.features, CAMERA, sensor)

    def recording(self, sensor: SensorConfig) -> TrackingInput:
        return TrackingInput(self.frames(sensor), self.words, self.matches)


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return T_gc of an upright camera (world z up)."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = position
    return T


def orbit(n: int, *, turns: float = 0.25, radius: float = 1.0) -> np.ndarray:
    """Return T_gc (n, 4, 4) of a camera on a circle that looks outward."""
    angle = np.linspace(0.0, turns * 2.0 * np.pi, n)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    return np.array([look_at(radius * d, 4.0 * d) for d in out])


def sweep(n: int, *, length: float = 0.6) -> np.ndarray:
    """Return T_gc (n, 4, 4) of a camera that moves sideways in front of the wall x = 3."""
    return np.array([look_at(np.array([0.0, y, 0.1 * np.sin(6 * y)]), np.array([3.0, 0.8 * y, 0.0])) for y in np.linspace(0, length, n)])


def room_points(n: int, rng: np.random.Generator, *, radius: float = 3.0) -> np.ndarray:
    """Return landmarks (n, 3) on a wavy cylinder wall around the origin."""
    angle, height = rng.uniform(0, 2 * np.pi, n), rng.uniform(-2.0, 2.0, n)
    r = radius + 0.3 * np.sin(5 * angle) + 0.2 * np.sin(7 * height)
    return np.stack([r * np.cos(angle), r * np.sin(angle), height], axis=1)


def observe(
    T_gc: np.ndarray,
    xyz: np.ndarray,
    rng: np.random.Generator,
    *,
    pixel_noise: float = 0.5,
    depth_noise: float = 1.0,
    flipped_bits: int = 8,
    per_frame: int = 400,
    blind: tuple = (),
) -> Scene:
    """Let a camera see landmarks: pixels and depths with noise, descriptors with flipped bits.

    depth_noise : multiple of the sensor's own sigma; blind : frames in which nothing is seen
    """
    desc = rng.integers(0, 256, (len(xyz), 32), dtype=np.uint8)
    reach = rng.uniform(4.0, 9.0, len(xyz))
    columns: dict[str, list] = {"xy": [], "depth": [], "octave": [], "angle": [], "desc": [], "landmark": []}
    offset = [0]
    for i, T in enumerate(T_gc):
        x_c = se3.transform(se3.inverse(T), xyz)
        z = x_c[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = CAMERA.project(x_c)
        inside = (z > 0.4) & (xy[:, 0] >= 8) & (xy[:, 0] < CAMERA.width - 8) & (xy[:, 1] >= 8) & (xy[:, 1] < CAMERA.height - 8)
        ids = np.flatnonzero(inside & (i not in blind))
        ids = np.sort(rng.permutation(ids)[:per_frame])
        octave = np.clip(np.round(np.log(reach[ids] / np.linalg.norm(x_c[ids], axis=1)) / np.log(OCTAVE_SCALE)), 0, 7)
        columns["xy"].append(xy[ids] + rng.normal(0, pixel_noise, (len(ids), 2)) * OCTAVE_SCALE ** octave[:, None])
        columns["depth"].append(z[ids] + rng.normal(0, 1, len(ids)) * depth_noise * (0.0012 + 0.0019 * (z[ids] - 0.4) ** 2))
        columns["octave"].append(octave)
        columns["angle"].append(np.zeros(len(ids)))
        columns["desc"].append(flip_bits(desc[ids], flipped_bits, rng))
        columns["landmark"].append(ids)
        offset.append(offset[-1] + len(ids))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    stamp = 100.0 + np.arange(len(T_gc)) / RATE
    features = Features(
        stamp=stamp,
        depth_stamp=stamp.copy(),
        offset=np.array(offset, dtype=np.int64),
        xy=joined["xy"].astype(np.float32),
        depth=joined["depth"].astype(np.float32),
        slope=np.zeros((len(joined["depth"]), 2), dtype=np.float32),
        octave=joined["octave"].astype(np.uint8),
        angle=joined["angle"].astype(np.float32),
        desc=joined["desc"],
        octave_scale=np.array(OCTAVE_SCALE),
    )
    landmark = joined["landmark"].astype(np.int64)
    return Scene(features, words_of(landmark, features.offset, len(xyz)), matches_of(landmark, features.offset), T_gc, landmark, xyz)


def flip_bits(desc: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Flip up to `n` random bits of each descriptor (N, 32)."""
    bits = np.unpackbits(desc, axis=1)
    rows = np.repeat(np.arange(len(desc)), n)
    bits[rows, rng.integers(0, 256, len(rows))] ^= 1
    return np.packbits(bits, axis=1)


def words_of(landmark: np.ndarray, offset: np.ndarray, n_words: int) -> Words:
    """Return every landmark a word of its own."""
    return Words(
        idf=np.ones(n_words, np.float32),
        word_offset=np.array(offset, np.int64),
        word=landmark.astype(np.int32),
        word_node=np.arange(n_words, dtype=np.int32) // 4,
        second_node=np.full(len(landmark), -1, np.int32),
    )


def matches_of(landmark: np.ndarray, offset: np.ndarray) -> Matches:
    """Match each frame to the one before by the truth."""
    pair, start, rows = [], [0], []
    for i in range(1, len(offset) - 1):
        _, row_i, row_j = np.intersect1d(
            landmark[offset[i] : offset[i + 1]], landmark[offset[i - 1] : offset[i]], assume_unique=True, return_indices=True
        )
        pair.append((i, i - 1))
        rows.append(np.stack([row_i, row_j], axis=1))
        start.append(start[-1] + len(row_i))
    joined = np.concatenate(rows) if rows else np.empty((0, 2))
    return Matches(pair=np.array(pair, np.int32).reshape(-1, 2), offset=np.array(start, np.int64), row=joined.astype(np.int32))


def ape(T_wc: np.ndarray, T_gc: np.ndarray) -> float:
    """Return the RMS position error [m] after rigid alignment, of the frames that have a pose."""
    has_pose = np.isfinite(T_wc[:, 0, 0])
    T_gw, _ = se3.umeyama(T_wc[has_pose, :3, 3], T_gc[has_pose, :3, 3])
    error = se3.transform(T_gw, T_wc[has_pose, :3, 3]) - T_gc[has_pose, :3, 3]
    return float(np.sqrt((error**2).sum(axis=1).mean()))
