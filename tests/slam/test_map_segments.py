"""Map segments: begun where tracking is lost for good, joined by places both saw, kept apart and told of otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from scene_run import SENSOR, Run
from scenes import ape, look_at, observe, room_points

from slamcli.config.options import TrackConfig
from slamcli.errors import SlamError
from slamcli.formats.trajectory import read_tum
from slamcli.geometry import se3
from slamcli.schema import LOST, RELOCALIZED, Map, Tracks, frame_poses, frame_segments, trajectory
from slamcli.slam import map_merging, map_segments
from slamcli.slam.loop_candidates import Candidate
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import loop, optimize, track


def on_circle(start: float, stop: float, n: int) -> np.ndarray:
    """Look outward from a small circle, from one share of a turn to another."""
    out = [np.array([np.cos(a), np.sin(a), 0.1 * np.sin(3 * a)]) for a in 2 * np.pi * np.linspace(start, stop, n)]
    return np.array([look_at(0.8 * d * [1, 1, 0] + [0, 0, d[2]], 4.0 * d) for d in out])


def scene_of(*arcs: tuple[float, float, int], seed: int = 0):
    rng = np.random.default_rng(seed)
    return observe(np.concatenate([on_circle(*arc) for arc in arcs]), room_points(9000, rng), rng)


@pytest.fixture(scope="module")
def apart(tmp_path_factory):
    """A jump to the other side of the room and no way back: 60 frames, then 40."""
    run = Run(scene_of((0.0, 0.4, 60), (0.62, 0.88, 40)), tmp_path_factory.mktemp("apart"))
    for module in (track, optimize, loop):
        run.stage(module)
    return run


def test_a_jump_into_the_unknown_begins_a_segment_with_the_first_frame_after_it(apart):
    tracks, map_ = apart.result("track")
    expected = np.zeros(100, int)
    expected[60:] = 1
    np.testing.assert_array_equal(frame_segments(tracks, map_), expected)
    assert apart.summary["track"]["segments"] == 2


@pytest.mark.parametrize(("n_after", "segments"), [(TrackConfig().segment_after - 1, 1), (TrackConfig().segment_after, 2)])
def test_a_segment_begins_only_when_enough_frames_were_lost(tmp_path, n_after: int, segments: int):
    run = Run(scene_of((0.0, 0.4, 60), (0.62, 0.7, n_after)), tmp_path)
    run.stage(track)
    assert run.summary["track"]["segments"] == segments
    assert run.summary["track"]["lost"] == (n_after if segments == 1 else 0)


def test_a_segment_never_joined_is_kept_in_its_own_frame_and_told_of(apart):
    tracks, map_ = apart.result("loop")
    assert apart.summary["loop"]["segments"] == 2 and apart.summary["loop"]["lost"] == 0
    for segment, frames in ((0, slice(0, 60)), (1, slice(60, 100))):
        T_wc = frame_poses(tracks, map_, segment)
        assert np.isfinite(T_wc[frames]).all() and np.isnan(np.delete(T_wc, np.r_[frames], axis=0)).all()
        assert 1e-5 < ape(T_wc, apart.scene.T_gc) < 0.02
    assert any("segment 1" in text and "60 to 99" in text and "trajectory_segment1.txt" in text for text in apart.warnings)


def test_what_a_run_shows_is_the_main_segment(apart):
    stamp = apart.scene.features.stamp
    tracks, map_ = apart.result("loop")
    np.testing.assert_allclose(read_tum(apart.folder / "loop/trajectory.txt").stamp, stamp[:60], atol=1e-6)
    np.testing.assert_allclose(read_tum(apart.folder / "loop/trajectory_segment1.txt").stamp, stamp[60:], atol=1e-6)
    assert len(trajectory(stamp, tracks, map_).stamp) == 60
    assert read_tum(apart.folder / "loop/keyframes.txt").stamp.max() < stamp[60]


def assert_begins_at_identity(path):
    np.testing.assert_allclose(read_tum(path).T_wc[0], np.eye(4), atol=2e-9)  # the file holds nine decimals


@pytest.mark.parametrize("stage", ["track", "optimize", "loop"])
def test_the_world_of_each_segment_is_its_first_frames_camera(apart, stage):
    tracks, map_ = apart.result(stage)
    for segment, name in enumerate(("trajectory.txt", "trajectory_segment1.txt")):
        assert_begins_at_identity(apart.folder / stage / name)
        first = np.flatnonzero(frame_segments(tracks, map_) == segment)[0]
        np.testing.assert_allclose(frame_poses(tracks, map_, segment)[first], np.eye(4), atol=1e-9)


def test_anchoring_moves_key_frames_landmarks_and_frames_of_a_segment_together(apart):
    tracks, map_ = apart.result("loop")
    moved = replace(map_, T_wk=map_.T_wk.copy(), lm_xyz=map_.lm_xyz.copy())
    lm_segment = map_.kf_segment[map_.obs_kf[np.searchsorted(map_.obs_lm, np.arange(len(map_.lm_xyz)))]]
    for segment in (0, 1):
        T = se3.exp(np.random.default_rng(segment).normal(size=6))
        moved.T_wk[map_.kf_segment == segment] = T @ map_.T_wk[map_.kf_segment == segment]
        moved.lm_xyz[lm_segment == segment] = se3.transform(T, map_.lm_xyz[lm_segment == segment])
    anchored = map_segments.from_first_frames(moved, tracks)
    np.testing.assert_allclose(anchored.T_wk, map_.T_wk, atol=1e-9)
    np.testing.assert_allclose(anchored.lm_xyz, map_.lm_xyz, atol=1e-9)


def test_a_frame_found_before_the_first_key_frame_is_the_origin(apart):
    tracks, map_ = apart.result("loop")
    T_kc = tracks.T_kc.copy()
    T_kc[0] = se3.exp(np.array([0.1, -0.2, 0.05, 0.03, 0.1, 0.0]))  # as if hindsight had found it from the key frame that follows
    ref_kf = tracks.ref_kf.copy()
    ref_kf[0] = 1
    early = replace(tracks, T_kc=T_kc, ref_kf=ref_kf)
    np.testing.assert_allclose(frame_poses(early, map_segments.from_first_frames(map_, early))[0], np.eye(4), atol=1e-12)


def test_another_segment_can_be_asked_for(apart):
    _, map_ = apart.result("optimize")
    tracks = apart.load(Tracks, "optimize")
    chosen = loop.main_first(map_, tracks, 1)
    np.testing.assert_array_equal(chosen.kf_segment, 1 - map_.kf_segment)
    gap = replace(map_, kf_segment=2 * map_.kf_segment)  # as when segment 1 was joined to another
    for given in (map_, gap):
        with pytest.raises(SlamError, match="loop.main_segment = 2: the map has 2 segments"):
            loop.main_first(given, tracks, 2)


def test_segments_that_saw_one_place_are_joined(tmp_path):
    run = Run(scene_of((0.0, 0.3, 50), (0.6, 1.2, 90)), tmp_path)
    for module in (track, optimize, loop):
        run.stage(module)
    assert run.summary["track"]["segments"] == 2 and run.summary["loop"]["segments"] == 1
    tracks, map_ = run.result("loop")
    assert (tracks.state != LOST).all() and not run.warnings[1:]
    assert 1e-5 < ape(frame_poses(tracks, map_), run.scene.T_gc) < 0.015
    assert_begins_at_identity(tmp_path / "loop/trajectory.txt")
    vertices = [line.split() for line in (tmp_path / "loop/posegraph.g2o").read_text().splitlines() if line.startswith("VERTEX")]
    np.testing.assert_allclose(np.array([v[2:5] for v in vertices], dtype=float), map_.T_wk[:, :3, 3], atol=1e-8)


def test_a_place_known_from_an_earlier_segment_is_recognized(tmp_path):
    run = Run(scene_of((0.0, 0.3, 40), (0.6, 0.8, 40), (0.1, 0.3, 40)), tmp_path)
    run.stage(track)
    tracks, map_ = run.result("track")
    assert frame_segments(tracks, map_)[[0, 79, 80, 119]].tolist() == [0, 1, 0, 0]
    assert tracks.state[80] in (RELOCALIZED, 2) and run.summary["track"]["segments"] == 2


@pytest.mark.shows("track.segment_after")
def test_zero_never_begins_a_segment(tmp_path):
    run = Run(scene_of((0.0, 0.2, 30), (0.6, 0.8, 30)), tmp_path)
    run.cfg.track = TrackConfig(segment_after=0)
    run.stage(track)
    tracks, _ = run.result("track")
    assert (tracks.state[:30] != LOST).all() and (tracks.state[30:] == LOST).all()
    assert "frames 30 to 59 (1.0 to 2.0 s) are lost: fewer than 15" in run.warnings[0]


def two_segments(rng) -> tuple[SparseMap, np.ndarray, np.ndarray]:
    """Six key frames of one world; the last three say they stand in another."""
    scene = scene_of((0.0, 0.2, 6))
    sparse_map = SparseMap(scene.features)
    T_ab = se3.exp(rng.normal(0, 1, 6))
    for k, T in enumerate(scene.T_gc):
        sparse_map.add_key_frame(k, T if k < 3 else se3.inverse(T_ab) @ T, int(k >= 3))
    return sparse_map, scene.T_gc, T_ab


def measured(T_gc, i, j, twist=None, n_inliers=90) -> Candidate:
    T_ij = se3.inverse(T_gc[i]) @ T_gc[j]
    return Candidate(i, j, 0.4, 100, n_inliers, T_ij=T_ij if twist is None else se3.exp(np.array(twist)) @ T_ij)


def test_closures_that_agree_join_and_the_one_that_does_not_is_left_out():
    sparse_map, T_gc, T_ab = two_segments(np.random.default_rng(1))
    true = [measured(T_gc, 3, 1, [0.004, 0, 0, 0, 0.002, 0]), measured(T_gc, 4, 2), measured(T_gc, 5, 0)]
    false = measured(T_gc, 5, 2, [0.5, 0, 0.2, 0, 0.3, 0])
    found = map_merging.find_join(sparse_map, [*true, false], least=2)
    assert found.closures == true
    np.testing.assert_allclose(found.T_ab, T_ab, atol=0.02)
    map_merging.join(sparse_map, found)
    assert (sparse_map.kf.segment == 0).all()
    np.testing.assert_allclose(sparse_map.kf.T_wk, T_gc, atol=0.03)


def test_one_closure_alone_joins_nothing():
    sparse_map, T_gc, _ = two_segments(np.random.default_rng(2))
    assert map_merging.find_join(sparse_map, [measured(T_gc, 3, 1)], least=2) is None
    assert map_merging.find_join(sparse_map, [measured(T_gc, 3, 1)], least=1) is not None


@pytest.mark.parametrize(
    ("twist", "agree"),
    [
        ([0.09, 0, 0, 0, 0, 0], True),
        ([0, 0.06, 0.06, 0, 0, 0], True),
        ([0, 0.08, 0.08, 0, 0, 0], False),
        ([0, 0, 0, 0.03, 0.03, 0], True),
        ([0, 0, 0, 0, 0, 0.055], False),
    ],
)
def test_closures_agree_within_a_tenth_of_a_metre_and_a_twentieth_of_a_radian(twist, agree):
    sparse_map, T_gc, _ = two_segments(np.random.default_rng(4))
    found = map_merging.find_join(sparse_map, [measured(T_gc, 3, 1), measured(T_gc, 3, 1, twist)], least=1)
    assert (found is not None) == agree, "two that differ contradict each other"
    assert not agree or (len(found.closures) == 2 and found.support == 180)


def test_a_join_moves_the_one_segment_and_no_other():
    sparse_map, T_gc, _ = two_segments(np.random.default_rng(5))
    sparse_map.kf.segment[5] = 2
    alone = sparse_map.kf.T_wk[5].copy()
    map_merging.join(sparse_map, map_merging.find_join(sparse_map, [measured(T_gc, 3, 1), measured(T_gc, 4, 2)], least=2))
    assert sparse_map.kf.segment.tolist() == [0, 0, 0, 0, 0, 2]
    np.testing.assert_allclose(sparse_map.kf.T_wk[:5], T_gc[:5], atol=1e-9)
    np.testing.assert_array_equal(sparse_map.kf.T_wk[5], alone)


@pytest.mark.parametrize(("n_inliers", "is_joined"), [(46, False), (45, True)])  # two of these, against two of 90
def test_what_looks_alike_in_two_places_joins_nothing(n_inliers, is_joined):
    sparse_map, T_gc, _ = two_segments(np.random.default_rng(3))
    true = [measured(T_gc, 3, 1), measured(T_gc, 4, 1)]
    next_door = se3.exp(np.array([2.0, 0, 0, 0, 0, 0]))
    alike = [measured(T_gc, i, 0, n_inliers=n_inliers) for i in (4, 5)]
    alike = [replace(c, T_ij=se3.inverse(T_gc[c.kf_i]) @ next_door @ T_gc[c.kf_j]) for c in alike]
    found = map_merging.find_join(sparse_map, [*true, *alike], least=2)
    assert (found is not None) == is_joined


@pytest.mark.parametrize(("n_inliers", "is_joined"), [(89, False), (180, True)])
def test_a_refused_join_speaks_against_any_weaker_placement_of_the_same_segments(n_inliers, is_joined):
    """The place repeats itself: what is left when the strongest placement cannot be is no more than its like next door."""
    sparse_map, T_gc, _ = two_segments(np.random.default_rng(3))
    refused = map_merging.find_join(sparse_map, [measured(T_gc, 3, 1), measured(T_gc, 4, 1, n_inliers=89)], least=2)
    left = [measured(T_gc, i, 2, n_inliers=n_inliers) for i in (4, 5)]
    assert map_merging.find_join(sparse_map, left, least=2) is not None
    assert (map_merging.find_join(sparse_map, left, least=2, refused=[refused]) is not None) == is_joined
    sparse_map.kf.segment[2:4] = 2
    assert map_merging.find_join(sparse_map, left, least=1, refused=[refused]) is not None, "it was between other segments"


def test_segments_are_numbered_by_their_frames():
    none = np.empty(0, np.int32)
    map_ = Map(
        np.arange(4, dtype=np.int32), np.array([0, 1, 2, 1], np.int32), np.tile(np.eye(4), (4, 1, 1)), np.empty((0, 3)), none, none,
        none.astype(np.int64),
    )  # fmt: skip
    ref_kf = np.array([0, 0, 1, 1, 3, 2, 2, -1], np.int32)
    tracks = Tracks(ref_kf, np.tile(np.eye(4), (8, 1, 1)), np.ones(8, np.uint8), np.ones(8, np.int32))
    assert map_segments.ranked(map_, tracks).kf_segment.tolist() == [1, 0, 2, 0]
    assert map_segments.ranked(map_, tracks, main=2).kf_segment.tolist() == [2, 1, 0, 1]
    assert frame_segments(tracks, map_).tolist() == [0, 0, 1, 1, 1, 2, 2, -1]


def test_each_segment_has_its_gauge_fixed(apart):
    _, map_ = apart.result("track")
    sparse_map = SparseMap.from_map(apart.scene.features, map_)
    part = map_adjustment.gather(sparse_map, np.arange(len(sparse_map.kf), dtype=np.int32), SENSOR)
    first = [int(np.flatnonzero(map_.kf_segment == s)[0]) for s in (0, 1)]
    np.testing.assert_array_equal(np.flatnonzero(part.is_fixed), first)
