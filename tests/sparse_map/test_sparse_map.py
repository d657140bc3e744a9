"""The growing map against an obvious twin, and the laws its tables keep."""

import numpy as np
import pytest
from scenes import CAMERA, observe, room_points, sweep

from slamcli.config.options import SensorConfig
from slamcli.geometry import se3
from slamcli.sparse_map import guided_matching, map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    return observe(sweep(6), room_points(3000, rng), rng, pixel_noise=0.3)


def build(scene, *, pose_noise: float = 0.0) -> SparseMap:
    """Every frame a key frame, landmarks by truth, created where first seen."""
    rng = np.random.default_rng(1)
    sparse_map, id_of = SparseMap(scene.features), {}
    for frame, T_gc in enumerate(scene.T_gc):
        T_wk = T_gc @ se3.exp(rng.normal(0, pose_noise, 6) * (frame > 0))
        kf = sparse_map.add_key_frame(frame, T_wk)
        rows = np.arange(scene.features.offset[frame], scene.features.offset[frame + 1])
        known = np.array([scene.landmark[r] in id_of for r in rows])
        sparse_map.observe(kf, np.array([id_of[scene.landmark[r]] for r in rows[known]], np.int32), rows[known])
        x_c = CAMERA.backproject(scene.features.xy[rows[~known]], scene.features.depth[rows[~known]])
        ids = sparse_map.add_landmarks(kf, rows[~known], se3.transform(T_wk, x_c))
        id_of |= dict(zip(scene.landmark[rows[~known]].tolist(), ids.tolist(), strict=True))
    sparse_map.refresh(np.arange(len(sparse_map.lm), dtype=np.int32))
    return sparse_map


def twin_observations(sparse_map: SparseMap) -> set:
    """All (landmark, key frame, row), read off the other table."""
    seen = set()
    for kf in range(len(sparse_map.kf)):
        rows = sparse_map.rows_of(kf)
        for row in range(rows.start, rows.stop):
            if sparse_map.lm_of_row[row] >= 0:
                seen.add((int(sparse_map.lm_of_row[row]), kf, row))
    return seen


def chained_observations(sparse_map: SparseMap) -> set:
    ids = np.arange(len(sparse_map.lm), dtype=np.int32)
    which, kf, row = sparse_map.observations_of(ids)
    assert (np.diff(which) >= 0).all() and (np.diff(kf)[np.diff(which) == 0] > 0).all()
    return set(zip(which.tolist(), kf.tolist(), row.tolist(), strict=True))


def test_both_tables_tell_the_same_after_any_edit(scene):
    sparse_map = build(scene)
    rng = np.random.default_rng(2)
    assert chained_observations(sparse_map) == twin_observations(sparse_map)
    occupied = np.flatnonzero(sparse_map.lm_of_row >= 0)
    sparse_map.remove_observations(rng.choice(occupied, 200, replace=False))
    assert chained_observations(sparse_map) == twin_observations(sparse_map)
    alive = np.flatnonzero(sparse_map.lm.is_alive)
    sparse_map.fuse(*rng.permutation(alive)[:100].reshape(2, -1))
    sparse_map.remove_landmarks(np.flatnonzero(sparse_map.lm.is_alive)[:50].astype(np.int32))
    assert chained_observations(sparse_map) == twin_observations(sparse_map)
    counts = np.bincount([lm for lm, _, _ in twin_observations(sparse_map)], minlength=len(sparse_map.lm))
    np.testing.assert_array_equal(counts, sparse_map.lm.n_obs)


def test_votes_and_landmarks_agree_with_sets(scene):
    sparse_map = build(scene)
    ids = sparse_map.landmarks_of(2)
    seen = twin_observations(sparse_map)
    expected = [len({lm for lm, k, _ in seen if k == kf} & set(ids.tolist())) for kf in range(len(sparse_map.kf))]
    np.testing.assert_array_equal(sparse_map.votes(ids), expected)
    assert set(sparse_map.landmarks_in(np.array([1, 4])).tolist()) == {lm for lm, k, _ in seen if k in (1, 4)}
    order, shared = sparse_map.covisible(2)
    assert 2 not in order and (np.diff(shared) <= 0).all() and len(order) == len(sparse_map.kf) - 1


def test_fused_landmarks_resolve_along_the_chain(scene):
    sparse_map = build(scene)
    sparse_map.fuse(np.array([1, 0, 3]), np.array([2, 1, 2]))  # the last pair comes too late: 2 is dead by then
    sparse_map.remove_landmarks(np.array([5], np.int32))
    np.testing.assert_array_equal(sparse_map.resolve(np.array([2, 1, 0, -1, 5])), [0, 0, 0, -1, -1])


def test_snapshot_round_trip(scene):
    sparse_map = build(scene)
    sparse_map.remove_landmarks(np.arange(0, 40, 2, dtype=np.int32))
    before = sparse_map.snapshot()
    after = SparseMap.from_map(scene.features, before).snapshot()
    for name in ("kf_frame", "kf_segment", "T_wk", "lm_xyz", "obs_lm", "obs_kf", "obs_row"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    keys = list(zip(before.obs_lm.tolist(), before.obs_kf.tolist(), strict=True))
    assert keys == sorted(set(keys))


def test_refresh_takes_the_most_central_descriptor(scene):
    sparse_map = build(scene)
    lm = int(np.argmax(sparse_map.lm.n_obs))
    _, _, rows = sparse_map.observations_of(np.array([lm], np.int32))
    bits = np.unpackbits(sparse_map.features.desc[rows], axis=1).astype(int)
    distance = np.abs(bits[:, None] - bits[None]).sum(axis=2)
    chosen = [i for i, row in enumerate(rows) if (sparse_map.desc[row] == sparse_map.lm.desc[lm]).all()]
    assert distance.sum(axis=1)[chosen[0]] == distance.sum(axis=1).min()


def test_adjustment_recovers_disturbed_key_frames(scene):
    sparse_map = build(scene, pose_noise=0.01)
    disturbed = np.linalg.norm(sparse_map.kf.T_wk[1:, :3, 3] - scene.T_gc[1:, :3, 3], axis=1).max()
    result = map_adjustment.adjust(sparse_map, np.arange(6, dtype=np.int32), CAMERA, SensorConfig(pixel_noise=0.3), max_iterations=20)
    recovered = np.linalg.norm(sparse_map.kf.T_wk[:, :3, 3] - scene.T_gc[:, :3, 3], axis=1).max()
    assert result is not None and result.cost[-1] < result.cost[0]
    assert disturbed > 0.01 and 1e-5 < recovered < 0.005
    np.testing.assert_array_equal(sparse_map.kf.T_wk[0], scene.T_gc[0])


def test_window_leaves_the_rest_where_it_is(scene):
    sparse_map = build(scene, pose_noise=0.005)
    before = sparse_map.kf.T_wk.copy()
    map_adjustment.adjust(sparse_map, np.array([3, 4], np.int32), CAMERA, SensorConfig(), max_iterations=5)
    moved = np.abs(sparse_map.kf.T_wk - before).max(axis=(1, 2)) > 0
    np.testing.assert_array_equal(moved, [False, False, False, True, True, False])


def test_carried_landmarks_keep_their_place_in_the_camera(scene):
    sparse_map = build(scene)
    ids = np.flatnonzero(sparse_map.lm.first_kf == 2).astype(np.int32)
    kfs, before = np.arange(6), sparse_map.kf.T_wk.copy()
    x_c = se3.transform(se3.inverse(before[2]), sparse_map.lm.xyz[ids])
    sparse_map.kf.T_wk[2] = before[2] @ se3.exp(np.array([0.1, 0.2, -0.1, 0.3, 0.1, 0.0]))
    map_adjustment.carry(sparse_map, ids, kfs, before)
    np.testing.assert_allclose(se3.transform(se3.inverse(sparse_map.kf.T_wk[2]), sparse_map.lm.xyz[ids]), x_c, atol=1e-12)


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
