"""Key frames join the map: landmarks on probation go or stay for the reasons given, and each new one meets the key frames around."""

import numpy as np
import pytest
from plain_maps import plain_map, share
from scenes import CAMERA, observe, room_points, sweep

from slamcli.config.options import SensorConfig, TrackConfig
from slamcli.slam import map_growth
from slamcli.slam.map_growth import COVISIBLE, MIN_FOUND, PROBATION, MapGrowth
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap

SENSOR = SensorConfig(pixel_noise=0.5)


@pytest.fixture
def scene():
    rng = np.random.default_rng(3)
    return observe(sweep(8, length=0.1), room_points(4000, rng), rng)


def insert(growth: MapGrowth, scene, i: int, landmark: np.ndarray | None = None) -> tuple[int, np.ndarray]:
    frame = scene.frames(SENSOR)[i]
    return growth.insert(i, frame, scene.T_gc[i], np.full(len(frame), -1, np.int32) if landmark is None else landmark, 0)


def on_probation(scene, n_key_frames: int = 1) -> tuple[SparseMap, MapGrowth, np.ndarray]:
    """A first key frame whose landmarks are new, and some after it that see nothing of them."""
    sparse_map = SparseMap(scene.features)
    growth = MapGrowth(sparse_map, scene.frames(SENSOR), TrackConfig())
    _, added = insert(growth, scene, 0)
    growth._on_probation = added
    for i in range(1, n_key_frames):
        sparse_map.add_key_frame(i, scene.T_gc[i])
    return sparse_map, growth, added


def test_every_feature_with_depth_that_shows_no_landmark_becomes_one(scene):
    sparse_map = SparseMap(scene.features)
    growth = MapGrowth(sparse_map, scene.frames(SENSOR), TrackConfig())
    n_depth = np.isfinite(scene.frames(SENSOR)[0].depth).sum()
    kf, added = insert(growth, scene, 0)
    assert (kf, len(added)) == (0, n_depth)
    frame = scene.frames(SENSOR)[1]
    landmark = np.full(len(frame), -1, np.int32)
    landmark[:40] = added[:40]
    _, more = insert(growth, scene, 1, landmark)
    assert len(more) == np.isfinite(frame.depth[40:]).sum()
    assert (sparse_map.lm.n_obs[added[:40]] == 2).all() and (sparse_map.lm.n_obs[added[40:]] == 1).all()
    error = np.linalg.norm(sparse_map.lm.xyz[added] - scene.xyz[scene.landmark[sparse_map.obs.row[: len(added)]]], axis=1)
    assert 0 < np.median(error) < 0.05


def test_what_frames_seldom_find_where_they_should_see_it_is_culled(scene):
    sparse_map, growth, added = on_probation(scene)
    sparse_map.lm.n_visible[added] = 20
    sparse_map.lm.n_found[added] = np.where(np.arange(len(added)) % 2, MIN_FOUND * 20, MIN_FOUND * 20 - 1)
    growth.cull(0)
    np.testing.assert_array_equal(sparse_map.lm.is_alive[added], np.arange(len(added)) % 2 == 1)


@pytest.mark.parametrize(("kf", "stays"), [(1, True), (2, False)])
def test_what_no_second_key_frame_sees_goes_after_two(scene, kf: int, stays: bool):
    sparse_map, growth, added = on_probation(scene, kf + 1)
    growth.cull(kf)
    assert sparse_map.lm.is_alive[added].all() == stays and sparse_map.lm.is_alive[added].any() == stays


def test_what_was_confirmed_in_time_is_never_culled_again(scene):
    sparse_map, growth, added = on_probation(scene, PROBATION + 1)
    frame = scene.frames(SENSOR)[1]
    sparse_map.observe(1, added[:50], frame.first_row + np.arange(50))
    growth.cull(2)
    np.testing.assert_array_equal(sparse_map.lm.is_alive[added], np.arange(len(added)) < 50)
    growth.cull(PROBATION)  # its probation ends
    sparse_map.lm.n_visible[added[:50]] = 1000
    growth.cull(PROBATION)
    assert sparse_map.lm.is_alive[added[:50]].all()


@pytest.mark.parametrize(("kf", "is_culled"), [(1, True), (PROBATION, True), (PROBATION + 1, False)])
def test_probation_lasts_three_key_frames_after_the_first(scene, kf: int, is_culled: bool):
    sparse_map, growth, added = on_probation(scene, PROBATION + 2)
    sparse_map.observe(1, added, scene.frames(SENSOR)[1].first_row + np.arange(len(added)))
    for before in range(1, kf):
        growth.cull(before)
    assert PROBATION == 3 and sparse_map.lm.is_alive[added].all()
    sparse_map.lm.n_visible[added] = 1000
    growth.cull(kf)
    assert sparse_map.lm.is_alive[added].any() != is_culled


def joined(monkeypatch: pytest.MonkeyPatch, *, edge: bool = False, **settings) -> tuple[list[list[int]], list[int]]:
    """Let key frame 5 settle, which shares 14, 15, 40, 30 and 20 landmarks with those before it.

    Returns the windows that were adjusted, and the key frames in which landmarks were looked for.
    """
    windows, looked_in = [], []
    monkeypatch.setattr(map_adjustment, "adjust", lambda _, kfs, *__, **___: windows.append(kfs.tolist()))
    monkeypatch.setattr(map_growth, "fuse_landmarks", lambda _, kf, *__, **___: looked_in.append(kf))
    sparse_map = plain_map(np.tile(np.eye(4), (6, 1, 1)))
    for other, n in enumerate((14, 15, 40, 30, 20)):
        share(sparse_map, (other, 5), n)
    if edge:
        sparse_map.add_edge(5, 0, np.eye(4), np.eye(6))
    growth = MapGrowth(sparse_map, FrameStore(sparse_map.features, CAMERA, SENSOR), TrackConfig(**settings))
    growth.cull_share_adjust(5, np.empty(0, np.int32), sparse_map.landmarks_of(5))
    return windows, looked_in


@pytest.mark.parametrize(("most", "window"), [(3, [2, 3, 5]), (4, [2, 3, 4, 5]), (20, [1, 2, 3, 4, 5])])
def test_the_window_holds_the_most_covisible_that_share_fifteen_landmarks(monkeypatch, most: int, window: list[int]):
    assert joined(monkeypatch, window_key_frames=most)[0] == [window]
    assert joined(monkeypatch, edge=True, window_key_frames=most)[0] == [[0, *window]], "and whatever depth joins to it"


@pytest.mark.parametrize(("most", "where"), [(0, []), (2, [2, 3]), (4, [2, 3, 4, 1]), (20, [2, 3, 4, 1])])
def test_landmarks_are_looked_for_in_the_most_covisible(monkeypatch, most: int, where: list[int]):
    assert joined(monkeypatch, share_key_frames=most)[1] == where


def test_a_key_frame_on_its_own_has_no_window_to_adjust(monkeypatch):
    monkeypatch.setattr(map_adjustment, "adjust", lambda *_, **__: pytest.fail("nothing around it"))
    sparse_map = plain_map(np.tile(np.eye(4), (2, 1, 1)))
    share(sparse_map, (0, 1), COVISIBLE - 1)
    MapGrowth(sparse_map, FrameStore(sparse_map.features, CAMERA, SENSOR), TrackConfig()).cull_share_adjust(
        1, np.empty(0, np.int32), np.empty(0, np.int32)
    )
