"""Tracking where texture ends: frames placed by the shape that their depth images show."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from boxroom import FURNITURE, look_along, render
from kinect import KINECT, coded, noisy
from scenes import ape

from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import LoopConfig, OptimizeConfig, SensorConfig, TrackConfig
from slamcli.console import silent
from slamcli.depth import icp
from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry import se3
from slamcli.schema import KEY_FRAME, LOST, ON_DEPTH, Features, Matches, Timing, Tracks, Words, frame_poses
from slamcli.slam import final_refinement, loop_pose_graph
from slamcli.slam.depth_tracking import DepthAligner, FramePoints
from slamcli.slam.final_refinement import DepthConstraints, Refinement
from slamcli.slam.recording import TrackedRecording, TrackingInput
from slamcli.slam.tracker import Tracker
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import optimize

SENSOR = SensorConfig()
RATE = 15.0
WALL = (((3.0, -20.0, -20.0), (3.2, 20.0, 20.0)),)


def turn(n: int, start: float = 3.6, step: float = 0.05) -> np.ndarray:
    """Return T_lc (n, 4, 4) of a camera that drives through a room's corner and turns."""
    return np.array([look_along([2.2 - 0.02 * k, 1.7 + 0.1 * np.sin(0.3 * k), 0.9], start + step * k, 0.3) for k in range(n)])


@cache
def corner(n: int = 14) -> CoarseImages:
    return coded([icp.coarsen(noisy(render(T, KINECT, FURNITURE), k)) for k, T in enumerate(turn(n))])


def blind(n: int) -> tuple[Features, Words, Matches]:
    """Return what extract and match make of n dark pictures."""
    none, stamp = np.zeros(0), 10.0 + np.arange(n) / RATE
    features = Features(
        stamp=stamp, depth_stamp=stamp.copy(), offset=np.zeros(n + 1, np.int64), xy=np.zeros((0, 2), np.float32),
        depth=none.astype("f4"), slope=np.zeros((0, 2), "f4"), octave=none.astype("u1"), angle=none.astype("f4"), desc=np.zeros((0, 32), np.uint8), octave_scale=np.array(1.2),
    )  # fmt: skip
    words = Words(np.ones(5, "f4"), np.zeros(n + 1, np.int64), none.astype("i4"), np.zeros(5, "i4"), none.astype("i4"))
    pair = np.stack([np.arange(1, n), np.arange(n - 1)], axis=1).astype(np.int32)
    return features, words, Matches(pair, np.zeros(n, np.int64), np.zeros((0, 2), np.int32))


def track(depth: CoarseImages, **settings) -> Tracker:
    features, words, matches = blind(len(depth))
    recording = TrackingInput(FrameStore(features, KINECT, SENSOR), words, matches, FramePoints(depth, KINECT, SENSOR))
    tracker = Tracker(recording, TrackConfig(**settings), np.random.default_rng(0))
    for i in range(len(depth)):
        tracker.process(i)
    return tracker


def test_a_drive_in_the_dark_is_followed():
    tracker = track(corner())
    tracks, map_ = tracker.tracks(), tracker.map()
    assert set(tracks.state) == {KEY_FRAME, ON_DEPTH} and tracks.state[0] == KEY_FRAME
    assert 1e-5 < ape(frame_poses(tracks, map_), turn(14)) < 0.01
    assert 2 <= len(map_.kf_frame) < 8 and len(map_.edge_kf) >= len(map_.kf_frame) - 1
    assert (map_.edge_kf[:, 0] > map_.edge_kf[:, 1]).all() and len(map_.lm_xyz) == 0


def test_edges_survive_the_map_and_hold_it_in_the_adjustment_and_in_the_pose_graph():
    map_ = track(corner()).map()
    sparse_map = SparseMap.from_map(blind(14)[0], map_)
    again = sparse_map.snapshot()
    for name in ("edge_kf", "edge_T_ij", "edge_information"):
        assert getattr(again, name).tobytes() == getattr(map_, name).tobytes()
    good = sparse_map.kf.T_wk.copy()
    sparse_map.kf.T_wk[1:] = se3.exp(np.random.default_rng(0).normal(size=(len(good) - 1, 6)) * 0.02) @ sparse_map.kf.T_wk[1:]
    result = map_adjustment.adjust(sparse_map, np.arange(len(good), dtype=np.int32), KINECT, SENSOR, max_iterations=30)
    assert result.cost[-1] < 0.05 * result.cost[0]
    assert np.abs(se3.log(sparse_map.kf.T_wk @ se3.inverse(good))).max() < 0.01
    edges, support = loop_pose_graph.covisibility_edges(sparse_map, LoopConfig())
    on_depth = {tuple(pair) for pair in map_.edge_kf.tolist()}
    assert on_depth <= {tuple(pair) for pair in edges.tolist()}
    assert all(n >= loop_pose_graph.DEPTH_SUPPORT for pair, n in zip(edges.tolist(), support, strict=True) if tuple(pair) in on_depth)


def test_same_input_same_bytes():
    a, b = track(corner()), track(corner())
    assert a.tracks().T_kc.tobytes() == b.tracks().T_kc.tobytes() and a.map().edge_T_ij.tobytes() == b.map().edge_T_ij.tobytes()


def test_a_flat_wall_begins_no_map_and_its_reason_is_given():
    T = [look_along([0.5 + 0.02 * k, 0.05 * k, 0.0], 0.0, 0.0) for k in range(4)]
    depth = coded([icp.coarsen(noisy(render(t, KINECT, WALL, None), k)) for k, t in enumerate(T)])
    tracker = track(depth)
    assert (tracker.tracks().state == LOST).all() and len(tracker.map().kf_frame) == 0
    assert "no map yet" in tracker.lost_reason[0]


@cache
def past_a_box(n: int = 16) -> tuple[CoarseImages, np.ndarray]:
    """Drive along a wall and a floor, past a box that is soon behind."""
    scene = (*WALL, ((-20.0, -20.0, -1.2), (20.0, 20.0, -1.0)), ((2.5, 0.8, -1.0), (3.0, 1.2, 0.3)))
    T = np.array([look_along([0.8, -0.07 * k, 0.0], 0.0, 0.3) for k in range(n)])
    return coded([icp.coarsen(noisy(render(t, KINECT, scene, None), k)) for k, t in enumerate(T)]), T


@pytest.mark.shows("track.depth_icp_hold")
@pytest.mark.parametrize("hold", [0.0, 0.2, 1.0])
def test_along_a_flat_wall_the_motion_goes_on_for_a_while(hold):
    depth, T_gc = past_a_box()
    tracker = track(depth, depth_icp_hold=hold)
    tracks = tracker.tracks()
    lost = np.flatnonzero(tracks.state == LOST)
    held = round(hold * RATE)  # frames
    first = int(np.flatnonzero(track(depth, depth_icp_hold=0.0).tracks().state == LOST)[0])
    np.testing.assert_array_equal(lost, np.arange(min(first + held, 16), 16))
    assert 3 < first < 14 and all("5 of 6 directions" in tracker.lost_reason[int(i)] for i in lost)
    T_wc = frame_poses(tracks, tracker.map())[: min(first + held, 16)]
    error = (se3.inverse(T_wc[0]) @ T_wc)[:, :3, 3] - (se3.inverse(T_gc[0]) @ T_gc[: len(T_wc)])[:, :3, 3]
    assert np.abs(error[:first]).max() < 0.02 and np.abs(error).max() < 0.08


def test_another_place_is_not_taken_for_the_one_before():
    wall = [icp.coarsen(noisy(render(look_along([0.5, 0.0, 0.0], 0.0, 0.0), KINECT, WALL, None), 40 + k)) for k in range(4)]
    tracker = track(coded([*corner().of(range(4)), *wall]))
    state = tracker.tracks().state
    assert (state[:4] != LOST).all() and (state[4:] == LOST).all()
    assert tracker.map().kf_segment.max() == 0


def test_frames_without_depth_are_lost_and_found_again():
    depth = corner().of(range(14))
    depth[5:7] = 0
    tracks = track(coded(depth)).tracks()
    np.testing.assert_array_equal(np.flatnonzero(tracks.state == LOST), [5, 6])
    assert ape(frame_poses(tracks, track(coded(depth)).map()), turn(14)) < 0.01


def test_key_frames_are_joined_only_where_they_show_the_same():
    depth = corner()
    sparse_map = SparseMap(blind(14)[0])
    T_wc = turn(14)
    for frame in (0, 2, 13):
        sparse_map.add_key_frame(frame, T_wc[frame])
    frame_points = FramePoints(depth, KINECT, SENSOR)
    shape = DepthAligner(sparse_map, frame_points, frame_points)
    assert shape.add_edge(1, 0)
    e = se3.log(sparse_map.edge.T_ij[0] @ se3.inverse(T_wc[0]) @ T_wc[2])
    assert np.linalg.norm(e) < 0.006
    sparse_map.kf.T_wk[2] = se3.exp([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]) @ sparse_map.kf.T_wk[2]
    assert not shape.add_edge(2, 0) and shape.add_edges(2) == 0 and len(sparse_map.edge) == 1


def test_edges_hold_for_the_instants_of_the_colour_images():
    """The depth cameras stand where they stand; the key frames, elsewhere on the way."""
    T_wd, T_cd = turn(14), se3.exp(np.array([[0.01, -0.02, 0.03, 0.02, -0.03, 0.01], [-0.02, 0.01, 0.0, 0.0, 0.03, 0.02]]))
    sparse_map = SparseMap(blind(14)[0])
    for kf, frame in enumerate((0, 2)):
        sparse_map.add_key_frame(frame, T_wd[frame] @ se3.inverse(T_cd[kf]))
    frame_points = FramePoints(corner(), KINECT, SENSOR)
    assert DepthAligner(sparse_map, frame_points, frame_points).add_edge(1, 0, T_cd)
    e = se3.log(sparse_map.edge.T_ij[0] @ se3.inverse(sparse_map.kf.T_wk[0]) @ sparse_map.kf.T_wk[1])
    assert np.linalg.norm(e) < 0.006


def revisit(frames: list[int], *, n: int = 60, pixel_noise: float = 2.0) -> SparseMap:
    """A map of true key frames at `frames` of the drive, that all see the same n landmarks, as bearings with coarse noise."""
    rng, T_wc = np.random.default_rng(5), turn(14)[frames]
    x_c = np.stack([rng.uniform(-0.3, 0.3, n), rng.uniform(-0.3, 0.3, n), rng.uniform(1.5, 3.0, n)], axis=1)
    xyz = se3.transform(T_wc[0], x_c)
    xy = np.concatenate([KINECT.project(se3.transform(se3.inverse(T), xyz)) for T in T_wc])
    stamp, rows = 10.0 + np.arange(len(frames)) / RATE, n * len(frames)
    features = Features(
        stamp=stamp, depth_stamp=stamp.copy(), offset=n * np.arange(len(frames) + 1), xy=(xy + rng.normal(0, pixel_noise, xy.shape)).astype("f4"),
        depth=np.full(rows, np.nan, "f4"), slope=np.zeros((rows, 2), "f4"), octave=np.zeros(rows, "u1"), angle=np.zeros(rows, "f4"),
        desc=np.tile(rng.integers(0, 256, (n, 32), dtype=np.uint8), (len(frames), 1)), octave_scale=np.array(1.2),
    )  # fmt: skip
    sparse_map = SparseMap(features)
    for k, T in enumerate(T_wc):
        sparse_map.add_key_frame(k, T)
    ids = sparse_map.add_landmarks(0, np.arange(n), xyz)
    for k in range(len(frames)):
        sparse_map.observe(k, ids, np.arange(k * n, (k + 1) * n))
    return sparse_map


@pytest.mark.parametrize("most", [0, 1, 6])
def test_a_second_look_joins_key_frames_that_see_the_same_and_moves_them_to_where_depth_shows_them(most):
    frames = [0, 2, 4, 6]
    sparse_map = revisit(frames)
    n = len(frames)
    tracks = Tracks(
        ref_kf=np.arange(n, dtype=np.int32),
        T_kc=np.tile(np.eye(4), (n, 1, 1)),
        state=np.full(n, KEY_FRAME, np.uint8),
        n_inliers=np.full(n, 60, np.int32),
    )
    store = FrameStore(sparse_map.features, KINECT, SENSOR)
    timing = Timing(np.array(0.0), np.array(0.0), np.array(0.0), np.zeros((n, 6)))
    depth = DepthConstraints(FramePoints(coded(corner().of(frames)), KINECT, SENSOR), timing, most=most)
    by = Refinement(TrackConfig(), depth, iterations=20)
    after, result = final_refinement.refine_all(sparse_map, TrackedRecording(store, tracks), by, progress=silent)
    assert len(sparse_map.edge) == {0: 0, 1: 3, 6: 6}[most]
    assert (after.state == KEY_FRAME).all() and result.cost[-1] < result.cost[0]
    true = turn(14)[frames]
    e = se3.log((se3.inverse(sparse_map.kf.T_wk[0]) @ sparse_map.kf.T_wk) @ se3.inverse(se3.inverse(true[0]) @ true))
    error = np.linalg.norm(e[1:, :3], axis=1).mean()
    assert 1e-4 < error < 0.01 if most else error > 0.02
    final_refinement.refine_all(sparse_map, TrackedRecording(store, after), by, progress=silent)
    assert len(sparse_map.edge) == {0: 0, 1: 3, 6: 6}[most], "no pair is joined twice"


@pytest.mark.shows("optimize.depth_icp_edges")
@pytest.mark.parametrize(("most", "n_edges"), [(0, 0), (1, 3)])
def test_optimize_aligns_as_many_depth_images_as_asked(most, n_edges):
    frames = [0, 2, 4, 6]
    sparse_map, n = revisit(frames), len(frames)
    tracks = Tracks(np.arange(n, dtype=np.int32), np.tile(np.eye(4), (n, 1, 1)), np.full(n, KEY_FRAME, np.uint8), np.full(n, 60, np.int32))
    sensing = Sensing(KINECT, Timing(np.array(0.0), np.array(0.0), np.array(np.nan), np.zeros((n, 6))), {})
    option = OptimizeConfig(depth_icp_edges=most, readout=False, move_depth=False)
    optimize.refine(
        sparse_map, optimize.Extracted(sparse_map.features, FramePoints(coded([corner()[frame] for frame in frames]), KINECT, SENSOR)),
        tracks, sensing, SimpleNamespace(optimize=option, sensor=SENSOR, track=TrackConfig()),
        SimpleNamespace(progress=lambda items, *_: items, workers=1),
    )  # fmt: skip
    assert len(sparse_map.edge) == n_edges


def test_key_frames_are_joined_the_same_with_any_number_of_threads():
    frames, found = [0, 2, 4, 6], []
    frame_points = FramePoints(coded(corner().of(frames)), KINECT, SENSOR)
    for workers in (1, 3):
        sparse_map = revisit(frames)
        assert (
            DepthAligner(sparse_map, frame_points, frame_points).add_covisible_edges(
                np.tile(np.eye(4), (4, 1, 1)), most=6, least=30, workers=workers
            )
            == 6
        )
        found.append(sparse_map.edge)
    for name in ("kf", "T_ij", "information"):
        np.testing.assert_array_equal(getattr(found[1], name), getattr(found[0], name))
