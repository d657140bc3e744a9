"""Tracking on simulated landmarks, with the truth known."""

from dataclasses import replace

import numpy as np
from scenes import CAMERA, ape, observe, orbit, room_points, sweep

from slamcli.config.options import SensorConfig, TrackConfig
from slamcli.geometry import se3
from slamcli.schema import KEY_FRAME, LOST, Matches, frame_poses
from slamcli.slam.tracker import Tracker
from slamcli.vision import optical_flow

SENSOR = SensorConfig(pixel_noise=0.5, depth_noise_base=0.0012, depth_noise_quadratic=0.0019)  # the noise that `observe` adds


def track(scene, **settings) -> Tracker:
    tracker = Tracker(scene.recording(SENSOR), TrackConfig(**settings), np.random.default_rng(0))
    for i in range(len(scene.T_gc)):
        tracker.process(i)
    return tracker


def test_a_sweep_is_followed_within_the_noise():
    rng = np.random.default_rng(3)
    scene = observe(sweep(40), room_points(4000, rng), rng)
    tracker = track(scene)
    tracks = tracker.tracks()
    assert (tracks.state != LOST).all() and tracks.state[0] == KEY_FRAME
    assert 1e-5 < ape(frame_poses(tracks, tracker.map()), scene.T_gc) < 0.004


def test_landmarks_join_the_views_of_one_true_point():
    rng = np.random.default_rng(4)
    scene = observe(sweep(40), room_points(4000, rng), rng)
    map_ = track(scene).map()
    true = scene.landmark[map_.obs_row]
    first = np.searchsorted(map_.obs_lm, np.arange(len(map_.lm_xyz)))
    assert np.mean(true == true[first[map_.obs_lm]]) > 0.995
    assert np.bincount(map_.obs_lm).mean() > 1.5


def test_same_seed_same_bytes():
    rng = np.random.default_rng(5)
    scene = observe(sweep(20), room_points(3000, rng), rng)
    a, b = track(scene), track(scene)
    assert a.tracks().T_kc.tobytes() == b.tracks().T_kc.tobytes()
    assert a.map().lm_xyz.tobytes() == b.map().lm_xyz.tobytes()


def test_blackout_is_reported_and_survived():
    rng = np.random.default_rng(6)
    scene = observe(sweep(60), room_points(4000, rng), rng, blind=range(25, 32))
    tracker = track(scene)
    tracks = tracker.tracks()
    np.testing.assert_array_equal(np.flatnonzero(tracks.state == LOST), np.arange(25, 32))
    assert all("features" in tracker.lost_reason[i] for i in range(25, 32))
    assert np.isnan(tracks.T_kc[27]).all() and tracks.ref_kf[27] == -1
    assert 1e-5 < ape(frame_poses(tracks, tracker.map()), scene.T_gc) < 0.006


def test_a_jump_out_of_the_known_is_lost_not_made_up():
    rng = np.random.default_rng(7)
    poses = np.concatenate([orbit(20, turns=0.05), orbit(20, turns=0.05) @ turn_about_y(np.pi)])
    scene = observe(poses, room_points(4000, rng), rng)
    tracker = track(scene, segment_after=0)
    tracks = tracker.tracks()
    assert (tracks.state[:20] != LOST).all() and (tracks.state[20:] == LOST).all()
    assert "agree with the map" in tracker.lost_reason[25]


def test_optical_flow_carries_over_a_jerk_that_descriptors_and_the_motion_model_miss():
    jerk, T_gc = 15, sweep(30)
    T_gc[jerk:] = T_gc[jerk:] @ se3.exp(np.array([0, 0, 0, 0, 0.1, 0]))  # 50 px in one frame
    rng = np.random.default_rng(8)
    scene = observe(T_gc, room_points(4000, rng), rng)
    here, there = (slice(*scene.features.offset[k : k + 2]) for k in (jerk, jerk - 1))
    went = CAMERA.project(se3.transform(se3.inverse(T_gc[jerk]), scene.xyz[scene.landmark[there]]))
    xy, is_free = scene.features.xy[here], np.ones(400, dtype=bool)
    flowed = optical_flow.match(xy, went, is_free_i=is_free, is_free_j=is_free, radius=2.0)
    states = {}
    for name, rows in (("flow", flowed), ("no match", np.empty((0, 2), dtype=np.int32))):
        tracker = track(replace(scene, matches=with_rows(scene.matches, jerk, rows)), segment_after=0, relocalize_inliers=1000)
        states[name] = tracker.tracks().state
        lost = np.flatnonzero(states[name] == LOST)
        assert name == "no match" or 1e-5 < ape(frame_poses(tracker.tracks(), tracker.map()), T_gc) < 0.005
    assert len(flowed) > 150 and (states["flow"] != LOST).all()
    assert lost[0] == jerk


def with_rows(matches: Matches, frame: int, rows: np.ndarray) -> Matches:
    """Return frame `frame` these matches with the one before, instead of its own."""
    parts = [
        rows if i == frame else matches.row[a:b] for (i, _), a, b in zip(matches.pair, matches.offset, matches.offset[1:], strict=False)
    ]
    offset = np.cumsum([0, *map(len, parts)])
    return Matches(pair=matches.pair, offset=offset, row=np.concatenate(parts))


def turn_about_y(angle: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 0] = T[2, 2] = np.cos(angle)
    T[0, 2], T[2, 0] = np.sin(angle), -np.sin(angle)
    return T


def test_frames_without_depth_are_tracked_by_bearing():
    rng = np.random.default_rng(8)
    scene = observe(sweep(30), room_points(4000, rng), rng)
    rows = np.arange(scene.features.offset[10], scene.features.offset[13])
    scene.features.depth[rows] = np.nan
    tracks = track(scene).tracks()
    assert (tracks.state[10:13] == 1).all()


def test_a_recording_of_one_frame():
    rng = np.random.default_rng(9)
    tracker = track(observe(sweep(2)[:1], room_points(2000, rng), rng))
    assert len(tracker.map().kf_frame) == 1 and tracker.tracks().state.tolist() == [KEY_FRAME]


def test_no_depth_anywhere_gives_no_map_and_says_why():
    rng = np.random.default_rng(10)
    scene = observe(sweep(5), room_points(2000, rng), rng)
    scene.features.depth[:] = np.nan
    tracker = track(scene)
    assert (tracker.tracks().state == LOST).all() and len(tracker.map().kf_frame) == 0
    assert "0 with depth" in tracker.lost_reason[4]


def test_a_place_seen_again_and_again_stops_the_map_from_growing():
    rng = np.random.default_rng(11)
    there, n = sweep(20), 8
    scene = observe(np.concatenate([there, there[::-1]] * n), room_points(3000, rng), rng)
    bounded, endless = (track(scene, key_frame_crowd=crowd) for crowd in (4, 10**6))
    assert (bounded.tracks().state != LOST).all()
    grown = [np.count_nonzero(t.map().kf_frame >= 20 * n) for t in (bounded, endless)]
    assert grown[0] < 0.4 * grown[1] and grown[1] >= 20 * n // 8
    assert 1e-5 < ape(frame_poses(bounded.tracks(), bounded.map()), scene.T_gc) < 0.004


def test_rotations_stay_orthonormal_from_key_frame_to_key_frame():
    rng = np.random.default_rng(12)
    scene = observe(sweep(60), room_points(3000, rng), rng)
    R = track(scene, key_frame_gap=1, key_frame_crowd=10**6).map().T_wk[:, :3, :3]
    assert len(R) == 60
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-12
