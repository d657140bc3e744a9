"""The growing map against an obvious twin, and the laws its tables keep."""

import numpy as np
import pytest
from scenes import CAMERA, observe, room_points, sweep

from slamcli.config.options import SensorConfig
from slamcli.geometry import se3
from slamcli.sparse_map import guided_matching, map_adjustment
from slamcli.sparse_map.sparse_map import MapBuilder


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    return observe(sweep(6), room_points(3000, rng), rng, pixel_noise=0.3)


def build(scene, *, pose_noise: float = 0.0) -> MapBuilder:
    """Every frame a key frame, landmarks by truth, created where first seen."""
    rng = np.random.default_rng(1)
    builder, id_of = MapBuilder(scene.features), {}
    for frame, T_gc in enumerate(scene.T_gc):
        T_wk = T_gc @ se3.exp(rng.normal(0, pose_noise, 6) * (frame > 0))
        kf = builder.add_key_frame(frame, T_wk)
        rows = np.arange(scene.features.offset[frame], scene.features.offset[frame + 1])
        known = np.array([scene.landmark[r] in id_of for r in rows])
        builder.observe(kf, np.array([id_of[scene.landmark[r]] for r in rows[known]], np.int32), rows[known])
        x_c = CAMERA.backproject(scene.features.xy[rows[~known]], scene.features.depth[rows[~known]])
        ids = builder.add_landmarks(kf, rows[~known], se3.transform(T_wk, x_c))
        id_of |= dict(zip(scene.landmark[rows[~known]].tolist(), ids.tolist(), strict=True))
    builder.refresh(np.arange(len(builder.lm), dtype=np.int32))
    return builder


def twin_observations(builder: MapBuilder) -> set:
    """All (landmark, key frame, row), read off the other table."""
    seen = set()
    for kf in range(len(builder.kf)):
        rows = builder.rows_of(kf)
        for row in range(rows.start, rows.stop):
            if builder.lm_of_row[row] >= 0:
                seen.add((int(builder.lm_of_row[row]), kf, row))
    return seen


def chained_observations(builder: MapBuilder) -> set:
    ids = np.arange(len(builder.lm), dtype=np.int32)
    which, kf, row = builder.observations_of(ids)
    assert (np.diff(which) >= 0).all() and (np.diff(kf)[np.diff(which) == 0] > 0).all()
    return set(zip(which.tolist(), kf.tolist(), row.tolist(), strict=True))


def test_both_tables_tell_the_same_after_any_edit(scene):
    builder = build(scene)
    rng = np.random.default_rng(2)
    assert chained_observations(builder) == twin_observations(builder)
    occupied = np.flatnonzero(builder.lm_of_row >= 0)
    builder.remove_observations(rng.choice(occupied, 200, replace=False))
    assert chained_observations(builder) == twin_observations(builder)
    alive = np.flatnonzero(builder.lm.is_alive)
    builder.fuse(*rng.permutation(alive)[:100].reshape(2, -1))
    builder.remove_landmarks(np.flatnonzero(builder.lm.is_alive)[:50].astype(np.int32))
    assert chained_observations(builder) == twin_observations(builder)
    counts = np.bincount([lm for lm, _, _ in twin_observations(builder)], minlength=len(builder.lm))
    np.testing.assert_array_equal(counts, builder.lm.n_obs)


def test_votes_and_landmarks_agree_with_sets(scene):
    builder = build(scene)
    ids = builder.landmarks_of(2)
    seen = twin_observations(builder)
    expected = [len({lm for lm, k, _ in seen if k == kf} & set(ids.tolist())) for kf in range(len(builder.kf))]
    np.testing.assert_array_equal(builder.votes(ids), expected)
    assert set(builder.landmarks_in(np.array([1, 4])).tolist()) == {lm for lm, k, _ in seen if k in (1, 4)}
    order, shared = builder.covisible(2)
    assert 2 not in order and (np.diff(shared) <= 0).all() and len(order) == len(builder.kf) - 1


def test_fused_landmarks_resolve_along_the_chain(scene):
    builder = build(scene)
    builder.fuse(np.array([1, 0, 3]), np.array([2, 1, 2]))  # the last pair comes too late: 2 is dead by then
    builder.remove_landmarks(np.array([5], np.int32))
    np.testing.assert_array_equal(builder.resolve(np.array([2, 1, 0, -1, 5])), [0, 0, 0, -1, -1])


def test_snapshot_round_trip(scene):
    builder = build(scene)
    builder.remove_landmarks(np.arange(0, 40, 2, dtype=np.int32))
    before = builder.snapshot()
    after = MapBuilder.from_map(scene.features, before).snapshot()
    for name in ("kf_frame", "kf_segment", "T_wk", "lm_xyz", "obs_lm", "obs_kf", "obs_row"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    keys = list(zip(before.obs_lm.tolist(), before.obs_kf.tolist(), strict=True))
    assert keys == sorted(set(keys))


def test_refresh_takes_the_most_central_descriptor(scene):
    builder = build(scene)
    lm = int(np.argmax(builder.lm.n_obs))
    _, _, rows = builder.observations_of(np.array([lm], np.int32))
    bits = np.unpackbits(builder.features.desc[rows], axis=1).astype(int)
    distance = np.abs(bits[:, None] - bits[None]).sum(axis=2)
    chosen = [i for i, row in enumerate(rows) if (builder.desc[row] == builder.lm.desc[lm]).all()]
    assert distance.sum(axis=1)[chosen[0]] == distance.sum(axis=1).min()


def test_adjustment_recovers_disturbed_key_frames(scene):
    builder = build(scene, pose_noise=0.01)
    disturbed = np.linalg.norm(builder.kf.T_wk[1:, :3, 3] - scene.T_gc[1:, :3, 3], axis=1).max()
    result = map_adjustment.adjust(builder, np.arange(6, dtype=np.int32), CAMERA, SensorConfig(pixel_noise=0.3), max_iterations=20)
    recovered = np.linalg.norm(builder.kf.T_wk[:, :3, 3] - scene.T_gc[:, :3, 3], axis=1).max()
    assert result is not None and result.cost[-1] < result.cost[0]
    assert disturbed > 0.01 and 1e-5 < recovered < 0.005
    np.testing.assert_array_equal(builder.kf.T_wk[0], scene.T_gc[0])


def test_window_leaves_the_rest_where_it_is(scene):
    builder = build(scene, pose_noise=0.005)
    before = builder.kf.T_wk.copy()
    map_adjustment.adjust(builder, np.array([3, 4], np.int32), CAMERA, SensorConfig(), max_iterations=5)
    moved = np.abs(builder.kf.T_wk - before).max(axis=(1, 2)) > 0
    np.testing.assert_array_equal(moved, [False, False, False, True, True, False])


def test_carried_landmarks_keep_their_place_in_the_camera(scene):
    builder = build(scene)
    ids = np.flatnonzero(builder.lm.first_kf == 2).astype(np.int32)
    kfs, before = np.arange(6), builder.kf.T_wk.copy()
    x_c = se3.transform(se3.inverse(before[2]), builder.lm.xyz[ids])
    builder.kf.T_wk[2] = before[2] @ se3.exp(np.array([0.1, 0.2, -0.1, 0.3, 0.1, 0.0]))
    map_adjustment.carry(builder, ids, kfs, before)
    np.testing.assert_allclose(se3.transform(se3.inverse(builder.kf.T_wk[2]), builder.lm.xyz[ids]), x_c, atol=1e-12)


def test_buckets_hold_each_feature_once_and_in_order():
    rng = np.random.default_rng(4)
    xy = rng.uniform(-30.0, [CAMERA.width + 30.0, CAMERA.height + 30.0], (500, 2)).astype(np.float32)
    xy[:3] = [[0.0, 0.0], [20.0, 20.0], [19.999999, 40.0]]
    start, order = guided_matching.sort_into_buckets(xy, CAMERA)
    columns, rows = -(-CAMERA.width // guided_matching.CELL), -(-CAMERA.height // guided_matching.CELL)
    cell = np.clip((xy.astype(np.float64) // guided_matching.CELL).astype(int), 0, [columns - 1, rows - 1])
    bucket = cell[:, 1] * columns + cell[:, 0]
    np.testing.assert_array_equal(order, np.argsort(bucket, kind="stable"))
    np.testing.assert_array_equal(start, np.searchsorted(np.sort(bucket), np.arange(columns * rows + 1)))
