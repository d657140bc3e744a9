"""Guided matching against a twin that looks at every feature for every landmark."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA

from slamcli.geometry import se3
from slamcli.sparse_map import guided_matching
from slamcli.sparse_map.guided_matching import FrameFeatures, Landmarks, SearchLimits

SCALE = 1.2
LIMITS = SearchLimits(radius_px=5.0, max_distance=64, ratio=0.9)


def frame(xy: np.ndarray, desc: np.ndarray, octave: np.ndarray) -> FrameFeatures:
    n, nothing = len(xy), np.full(len(xy), np.nan)
    start, rows = guided_matching.sort_into_buckets(xy, CAMERA)
    return FrameFeatures(
        camera=CAMERA, xy=xy, depth=nothing, octave=octave, angle=np.zeros(n, np.float32), desc=desc, sigma_px=np.ones(n), sigma_z=nothing, first_row=0,
        bucket_start=start, bucket_rows=rows,
    )  # fmt: skip


def bits(a: np.ndarray, b: np.ndarray) -> int:
    return sum(int(x ^ y).bit_count() for x, y in zip(a.tolist(), b.tolist(), strict=True))


def slow_search(T_cw, landmarks: Landmarks, seen: FrameFeatures, *, radius_px: float, max_distance: int, ratio: float):
    feature, is_visible = np.full(len(landmarks.xyz), -1), np.zeros(len(landmarks.xyz), dtype=bool)
    owner: dict[int, tuple[int, int]] = {}
    centre = se3.inverse(T_cw)[:3, 3]
    for k, x_w in enumerate(landmarks.xyz):
        x_c = T_cw[:3, :3] @ x_w + T_cw[:3, 3]
        sight = x_w - centre
        distance = np.linalg.norm(sight)
        if x_c[2] <= 0.05 or sight @ landmarks.direction[k] < 0.5 * distance:
            continue
        u, v = CAMERA.project(x_c)
        level = round(np.log(landmarks.reach[k] / distance) / np.log(SCALE))
        if not (0 <= u < CAMERA.width and 0 <= v < CAMERA.height and -2 <= level <= 9):
            continue
        is_visible[k], level = True, max(level, 0)
        near = np.abs(seen.xy - [u, v]).max(axis=1) <= radius_px * SCALE**level
        rows = seen.bucket_rows[near[seen.bucket_rows] & (np.abs(seen.octave[seen.bucket_rows].astype(int) - level) <= 1)]
        found = sorted((bits(landmarks.desc[k], seen.desc[j]), place, int(j)) for place, j in enumerate(rows))
        if not found or found[0][0] > max_distance:
            continue
        best, _, row = found[0]
        if len(found) > 1 and seen.octave[found[1][2]] == seen.octave[row] and best > ratio * found[1][0]:
            continue
        if row in owner and best >= owner[row][1]:
            continue
        if row in owner:
            feature[owner[row][0]] = -1
        owner[row], feature[k] = (k, best), row
    return feature, is_visible


def scene(seed: int, n: int = 300) -> tuple[np.ndarray, Landmarks, FrameFeatures]:
    """Landmarks in and beside the view, and features near the projections of most, whose descriptors differ from theirs by some bits."""
    rng = np.random.default_rng(seed)
    T_cw = se3.exp(rng.normal(0, 0.2, 6))
    xyz = rng.uniform([-3, -2, -0.5], [3, 2, 6], (n, 3))
    xyz[: n // 3] = xyz[n // 3 : 2 * (n // 3)] + rng.normal(0, 0.005, (n // 3, 3))  # they compete for features
    x_c = se3.transform(T_cw, xyz)
    desc = rng.integers(0, 1 << 63, (n, 4), dtype=np.uint64)
    sight = xyz - se3.inverse(T_cw)[:3, 3]
    distance = np.linalg.norm(sight, axis=1)
    direction = sight / distance[:, None] + rng.normal(0, 0.5, (n, 3))
    landmarks = Landmarks(
        xyz, desc, direction / np.linalg.norm(direction, axis=1, keepdims=True), distance * SCALE ** rng.uniform(-3.4, 10.4, n), SCALE
    )
    seen = np.flatnonzero(x_c[:, 2] > 0.1)
    xy = (CAMERA.project(x_c[seen]) + rng.normal(0, 4, (len(seen), 2))).astype(np.float32)
    changed = desc[seen].copy()
    for k in range(30):
        changed[rng.random(len(seen)) < 0.5, k % 4] ^= np.uint64(1 << int(rng.integers(63)))
    return T_cw, landmarks, frame(xy, changed, rng.integers(0, 8, len(seen)).astype(np.uint8))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "checks", [{"max_distance": 64, "ratio": 0.9}, {"max_distance": 14, "ratio": 1.0}, {"max_distance": 256, "ratio": 0.7}]
)
def test_search_finds_what_the_slow_twin_finds(seed: int, checks: dict) -> None:
    T_cw, landmarks, seen = scene(seed)
    found = guided_matching.search(T_cw, landmarks, seen, SearchLimits(radius_px=5.0, **checks))
    expected = slow_search(T_cw, landmarks, seen, radius_px=5.0, **checks)
    assert expected[1].sum() > 50
    assert checks["max_distance"] < 64 or (expected[0] >= 0).sum() > 5
    np.testing.assert_array_equal(found[1], expected[1])
    np.testing.assert_array_equal(found[0], expected[0])


def test_landmarks_with_values_that_are_not_finite_are_not_seen() -> None:
    T_cw, landmarks, seen = scene(0)
    for change in ({"xyz": landmarks.xyz * np.nan}, {"reach": landmarks.reach * np.nan}, {"reach": landmarks.reach * np.inf}):
        feature, is_visible = guided_matching.search(T_cw, replace(landmarks, **change), seen, LIMITS)
        assert not is_visible.any() and (feature == -1).all()


def test_without_features_or_landmarks_nothing_is_found() -> None:
    T_cw, landmarks, _ = scene(0)
    nothing = frame(np.zeros((0, 2), np.float32), np.zeros((0, 4), np.uint64), np.zeros(0, np.uint8))
    assert (guided_matching.search(T_cw, landmarks, nothing, LIMITS)[0] == -1).all()
    none = Landmarks(np.zeros((0, 3)), np.zeros((0, 4), np.uint64), np.zeros((0, 3)), np.zeros(0), SCALE)
    assert len(guided_matching.search(T_cw, none, nothing, LIMITS)[0]) == 0
