"""Landmarks found in another key frame become views of it, or merge with the one that is there; far off ones do neither."""

import numpy as np
import pytest
from scenes import CAMERA, observe, room_points, sweep

from slamcli.config.options import SensorConfig
from slamcli.sparse_map.frame import frame_features
from slamcli.sparse_map.landmark_fusion import fuse_landmarks
from slamcli.sparse_map.sparse_map import MapBuilder

SENSOR = SensorConfig(pixel_noise=0.5)


@pytest.fixture
def two():
    """Two key frames at their true poses; the first has landmarks. Returns the map, the scene, and those."""
    rng = np.random.default_rng(5)
    scene = observe(sweep(2, length=0.05), room_points(4000, rng), rng)
    builder = MapBuilder(scene.features)
    for i in range(2):
        builder.add_key_frame(i, scene.T_gc[i])
    return builder, scene, add_landmarks(builder, scene, 0)


def add_landmarks(builder: MapBuilder, scene, kf: int) -> np.ndarray:
    rows = np.arange(scene.features.offset[kf], scene.features.offset[kf + 1])
    rows = rows[np.isfinite(scene.features.depth[rows])]
    return builder.add_landmarks(kf, rows, scene.xyz[scene.landmark[rows]])


def true_share(builder: MapBuilder, scene) -> float:
    """Share of the second key frame's views that show the landmark's own true point."""
    rows = np.arange(builder.rows_of(1).start, builder.rows_of(1).stop)
    ids = builder.lm_of_row[rows]
    rows, ids = rows[ids >= 0], ids[ids >= 0]
    return float(np.mean(np.linalg.norm(scene.xyz[scene.landmark[rows]] - builder.lm.xyz[ids], axis=1) < 1e-9))


def test_a_free_feature_becomes_a_view(two):
    builder, scene, ids = two
    both = np.intersect1d(scene.landmark[builder.rows_of(0)], scene.landmark[builder.rows_of(1)])
    n = fuse_landmarks(builder, 1, ids, CAMERA, SENSOR, max_distance=50)
    assert 0.7 * len(both) < n <= len(both)
    assert (builder.lm.n_obs[ids] == 2).sum() == n
    assert true_share(builder, scene) > 0.99
    assert fuse_landmarks(builder, 1, ids[builder.lm.n_obs[ids] == 2], CAMERA, SENSOR, max_distance=50) == 0  # it sees them already


def test_a_landmark_that_is_there_already_is_merged_and_the_older_name_leads_to_it(two):
    builder, scene, ids = two
    there = add_landmarks(builder, scene, 1)
    n = fuse_landmarks(builder, 1, ids, CAMERA, SENSOR, max_distance=50)
    gone = ids[~builder.lm.is_alive[ids]]
    assert len(gone) == n > 100
    kept = builder.resolve(gone)
    assert np.isin(kept, there).all() and (builder.lm.n_obs[kept] == 2).all()
    np.testing.assert_allclose(builder.lm.xyz[kept], builder.lm.xyz[gone], atol=1e-9)


@pytest.mark.parametrize(("shift_px", "nearer"), [(4.0 * SENSOR.pixel_noise * 3.0, 1.0), (0.0, 0.8)])
def test_what_lies_beside_the_projection_or_at_another_depth_is_left_alone(two, shift_px: float, nearer: float):
    builder, scene, ids = two
    frame = frame_features(scene.features, 1, CAMERA, SENSOR)
    centre = scene.T_gc[1][:3, 3]
    aside = scene.T_gc[1][:3, 0] * shift_px / CAMERA.fx * np.median(frame.depth)
    builder.lm.xyz[ids] = centre + nearer * (builder.lm.xyz[ids] - centre) + aside
    assert fuse_landmarks(builder, 1, ids, CAMERA, SENSOR, max_distance=50) < 0.03 * len(ids)
