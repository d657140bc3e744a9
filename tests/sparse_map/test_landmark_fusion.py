"""Landmarks found in another key frame become views of it, or merge with the one that is there; far off ones do neither."""

import numpy as np
import pytest
from scenes import CAMERA, observe, room_points, sweep

from slamcli.config.options import SensorConfig
from slamcli.sparse_map.landmark_fusion import fuse_landmarks
from slamcli.sparse_map.sparse_map import SparseMap

SENSOR = SensorConfig(pixel_noise=0.5)


@pytest.fixture
def two():
    """Two key frames at their true poses; the first has landmarks. Returns the map, the scene, and those."""
    rng = np.random.default_rng(5)
    scene = observe(sweep(2, length=0.05), room_points(4000, rng), rng)
    sparse_map = SparseMap(scene.features)
    for i in range(2):
        sparse_map.add_key_frame(i, scene.T_gc[i])
    return sparse_map, scene, add_landmarks(sparse_map, scene, 0)


def add_landmarks(sparse_map: SparseMap, scene, kf: int) -> np.ndarray:
    rows = np.arange(scene.features.offset[kf], scene.features.offset[kf + 1])
    rows = rows[np.isfinite(scene.features.depth[rows])]
    return sparse_map.add_landmarks(kf, rows, scene.xyz[scene.landmark[rows]])


def true_share(sparse_map: SparseMap, scene) -> float:
    """Share of the second key frame's views that show the landmark's own true point."""
    rows = np.arange(sparse_map.rows_of(1).start, sparse_map.rows_of(1).stop)
    ids = sparse_map.lm_of_row[rows]
    rows, ids = rows[ids >= 0], ids[ids >= 0]
    return float(np.mean(np.linalg.norm(scene.xyz[scene.landmark[rows]] - sparse_map.lm.xyz[ids], axis=1) < 1e-9))


def test_a_free_feature_becomes_a_view(two):
    sparse_map, scene, ids = two
    both = np.intersect1d(scene.landmark[sparse_map.rows_of(0)], scene.landmark[sparse_map.rows_of(1)])
    n = fuse_landmarks(sparse_map, 1, ids, scene.frames(SENSOR), max_distance=50)
    assert 0.7 * len(both) < n <= len(both)
    assert (sparse_map.lm.n_obs[ids] == 2).sum() == n
    assert true_share(sparse_map, scene) > 0.99
    assert (
        fuse_landmarks(sparse_map, 1, ids[sparse_map.lm.n_obs[ids] == 2], scene.frames(SENSOR), max_distance=50) == 0
    )  # it sees them already


def test_a_landmark_that_is_there_already_is_merged_and_the_older_name_leads_to_it(two):
    sparse_map, scene, ids = two
    there = add_landmarks(sparse_map, scene, 1)
    n = fuse_landmarks(sparse_map, 1, ids, scene.frames(SENSOR), max_distance=50)
    gone = ids[~sparse_map.lm.is_alive[ids]]
    assert len(gone) == n > 100
    kept = sparse_map.resolve(gone)
    assert np.isin(kept, there).all() and (sparse_map.lm.n_obs[kept] == 2).all()
    np.testing.assert_allclose(sparse_map.lm.xyz[kept], sparse_map.lm.xyz[gone], atol=1e-9)


@pytest.mark.parametrize(("shift_px", "nearer"), [(4.0 * SENSOR.pixel_noise * 3.0, 1.0), (0.0, 0.8)])
def test_what_lies_beside_the_projection_or_at_another_depth_is_left_alone(two, shift_px: float, nearer: float):
    sparse_map, scene, ids = two
    frame = scene.frames(SENSOR)[1]
    centre = scene.T_gc[1][:3, 3]
    aside = scene.T_gc[1][:3, 0] * shift_px / CAMERA.fx * np.median(frame.depth)
    sparse_map.lm.xyz[ids] = centre + nearer * (sparse_map.lm.xyz[ids] - centre) + aside
    assert fuse_landmarks(sparse_map, 1, ids, scene.frames(SENSOR), max_distance=50) < 0.03 * len(ids)
