"""What the options of the sensor and of track do, in the direction that their help promises."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from boxroom import KINECT, kinect_noise, look_along, render
from scenes import CAMERA, OCTAVE_SCALE, Scene, flip_bits, observe, room_points, sweep

from slamcli.config.options import SensorConfig, TrackConfig
from slamcli.depth import icp
from slamcli.geometry import se3
from slamcli.schema import LOST
from slamcli.slam import initial_pose
from slamcli.slam.initial_pose import Correspondences
from slamcli.slam.local_map import LocalMap
from slamcli.slam.map_growth import MapGrowth
from slamcli.slam.relocalization import Relocalizer
from slamcli.slam.tracker import Tracker
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import track as track_stage
from slamcli.stages.moving_parts import NOTHING

SENSOR = SensorConfig(pixel_noise=0.5)
NEAR, FAR = (lambda z: z < 1.5), (lambda z: z > 3.0)


def seen(T_gc: np.ndarray | None = None, *, n: int = 8, **settings) -> Scene:
    rng = np.random.default_rng(3)
    return observe(sweep(n, length=0.02 * n) if T_gc is None else T_gc, room_points(3000, rng), rng, **settings)


def tracked(scene: Scene, **settings) -> Tracker:
    tracker = Tracker(scene.recording(SENSOR), TrackConfig(**settings), np.random.default_rng(0))
    for i in range(len(scene.T_gc)):
        tracker.process(i)
    return tracker


def mapped(scene: Scene, **settings) -> tuple[SparseMap, MapGrowth]:
    """A map of true key frames of which each landmark is seen by all that see it."""
    sparse_map, id_of = SparseMap(scene.features), {}
    for frame, T_gc in enumerate(scene.T_gc):
        kf = sparse_map.add_key_frame(frame, T_gc)
        rows = np.arange(*scene.features.offset[frame : frame + 2])
        of = scene.landmark[rows]
        known = np.array([landmark in id_of for landmark in of.tolist()])
        sparse_map.observe(kf, np.array([id_of[landmark] for landmark in of[known].tolist()], np.int32), rows[known])
        ids = sparse_map.add_landmarks(kf, rows[~known], scene.xyz[of[~known]])
        id_of |= dict(zip(of[~known].tolist(), ids.tolist(), strict=True))
    return sparse_map, MapGrowth(sparse_map, scene.frames(SENSOR), TrackConfig(**settings))


# sensor


@pytest.mark.shows("sensor.depth_noise_base", "sensor.depth_noise_quadratic")
def test_depth_noise_is_what_a_depth_in_the_map_is_worth() -> None:
    features = seen(n=2).features
    usual, near, far = (
        map_adjustment.measure(features, slice(None), SensorConfig(**noise)).sigma_z
        for noise in ({}, {"depth_noise_base": 0.05}, {"depth_noise_quadratic": 0.05})
    )
    has = np.isfinite(usual)
    np.testing.assert_allclose((near - usual)[has], 0.042)
    grown, away = (far - usual)[has], features.depth[has] - 0.4
    np.testing.assert_allclose(grown, 0.042 * away**2, rtol=1e-5)


@pytest.mark.shows("sensor.pixel_noise")
def test_pixel_noise_is_that_of_octave_0_and_grows_with_the_scale() -> None:
    features = seen(n=2).features
    sigma = map_adjustment.measure(features, slice(None), SensorConfig(pixel_noise=3.0)).sigma_px
    np.testing.assert_allclose(sigma, 3.0 * OCTAVE_SCALE ** features.octave.astype(float))


@pytest.mark.shows("sensor.depth_min", "sensor.depth_max")
def test_depth_out_of_the_sensors_reach_is_ignored() -> None:
    features = seen(n=2).features
    depth = map_adjustment.measure(features, slice(None), SensorConfig(depth_min=2.6, depth_max=3.0)).depth
    np.testing.assert_array_equal(np.isfinite(depth), (features.depth >= 2.6) & (features.depth <= 3.0))
    assert 0 < np.isfinite(depth).sum() < len(depth)


@pytest.mark.shows("sensor.reading_noise_base", "sensor.reading_noise_quadratic")
def test_the_more_a_reading_is_believed_to_err_the_fewer_steps_are_edges_and_the_less_a_point_weighs() -> None:
    T = look_along([2.0, 2.0, 0.7], 0.4, 0.3)
    coarse = icp.coarsen(kinect_noise(render(T), np.random.default_rng(0)))
    usual, base, quadratic = (
        icp.surface_points(coarse, KINECT, SensorConfig(**noise))
        for noise in ({}, {"reading_noise_base": 0.02}, {"reading_noise_quadratic": 0.02})
    )
    for noisy in (base, quadratic):
        assert len(noisy) > 1.01 * len(usual) and noisy.variance.mean() > 4.0 * usual.variance.mean()
    near, far = ([points.variance[is_there(points.xyz[:, 2])].mean() for points in (base, quadratic)] for is_there in (NEAR, FAR))
    assert near[1] < near[0] and far[1] > 4.0 * far[0]


# track: from frame to frame


@pytest.mark.shows("track.min_inliers")
def test_a_frame_with_fewer_inliers_than_asked_for_is_lost() -> None:
    scene = seen(n=4)
    assert [(tracked(scene, min_inliers=n).tracks().state == LOST).sum() for n in (15, 1000)] == [0, 3]


@pytest.mark.shows("track.start_features")
def test_a_map_begins_with_so_many_features_with_depth() -> None:
    tracker = tracked(seen(n=2), start_features=1000)
    assert len(tracker.map().kf_frame) == 0 and "1000 wanted" in tracker.lost_reason[0]


def n_found(*, noise: float, **settings) -> int:
    """Of twelve frames of which three fifths of the matches are wrong and whose motion is unknown, count those that are found."""
    scene, found = seen(n=1, pixel_noise=0.1), 0
    rows = np.arange(150)
    frame = scene.frames(SENSOR)[0]
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x = scene.xyz[scene.landmark[rows]] + rng.normal(0, noise, (150, 3))
        x[60:] = rng.permutation(x[60:])
        correspondences = Correspondences(rows, x, np.full(150, -1, np.int32))
        nowhere = se3.inverse(scene.T_gc[0] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 2.5, 0.0])))
        estimate = initial_pose.estimate(correspondences, nowhere, frame, TrackConfig(**settings), rng)
        found += estimate is not None and np.linalg.norm(estimate.T_cw[:3, 3] - se3.inverse(scene.T_gc[0])[:3, 3]) < 0.1
    return found


@pytest.mark.shows("track.ransac_rounds")
def test_more_samples_find_more_poses() -> None:
    assert n_found(noise=0.0, ransac_rounds=2) < 9 <= n_found(noise=0.0, ransac_rounds=400)


@pytest.mark.shows("track.ransac_threshold_px")
def test_a_threshold_below_the_noise_tells_no_pose_from_another() -> None:
    assert n_found(noise=0.01, ransac_threshold_px=1e-3) < n_found(noise=0.01, ransac_threshold_px=4.0) - 3


def meets(scene: Scene, *, off_px: float = 0.0, **settings) -> tuple[int, SparseMap]:
    """Count the landmarks found in the last frame, of a map of those before, from a pose `off_px` off."""
    sparse_map, _ = mapped(replace(scene, T_gc=scene.T_gc[:-1]))
    last = len(scene.T_gc) - 1
    frame = scene.frames(SENSOR)[last]
    T_cw = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, off_px / CAMERA.fx, 0.0])) @ se3.inverse(scene.T_gc[last])
    found = LocalMap(sparse_map, TrackConfig(**settings)).match(frame, T_cw, sparse_map.landmarks_of(0), wanted=15)
    return 0 if found is None else int((found.landmark >= 0).sum()), sparse_map


@pytest.mark.shows("track.search_radius_px")
def test_landmarks_are_found_within_the_search_radius() -> None:
    scene = seen(n=3)
    assert meets(scene, off_px=12.0, search_radius_px=1.0)[0] == 0 and meets(scene, off_px=12.0, search_radius_px=15.0)[0] > 50


@pytest.mark.shows("track.search_max_distance")
def test_landmarks_whose_descriptors_differ_more_are_not_found() -> None:
    scene = seen(n=3, flipped_bits=30)
    assert meets(scene, search_max_distance=25)[0] == 0 and meets(scene, search_max_distance=80)[0] > 50


@pytest.mark.shows("track.search_ratio")
def test_a_landmark_with_a_rival_is_left_out_by_a_strict_ratio() -> None:
    scene = seen(n=3)
    scene.features.octave[:], scene.features.desc[:] = 0, 0
    scene.features.desc[:, 0], scene.features.desc[:, 1] = scene.landmark % 256, scene.landmark // 256  # rivals differ by a few bits
    scene.features.desc[:] = flip_bits(scene.features.desc, 3, np.random.default_rng(0))
    strict, loose = (meets(scene, search_radius_px=40.0, search_ratio=ratio)[0] for ratio in (0.5, 1.0))
    assert strict < 0.5 * loose


@pytest.mark.shows("track.local_key_frames")
def test_more_key_frames_bring_more_landmarks_to_look_for() -> None:
    scene = seen(sweep(6, length=1.2))
    visible = [meets(scene, local_key_frames=n)[1].lm.n_visible[:2000].sum() for n in (1, 20)]
    assert 1.05 * visible[0] < visible[1]


# track: relocalization, depth, moving objects


@pytest.mark.shows("track.relocalize_candidates")
def test_a_place_is_found_if_its_key_frame_is_among_those_tried() -> None:
    """The words name two other key frames first."""
    scene = seen(np.concatenate([sweep(1), sweep(2)[:1] @ turned(np.pi), sweep(2)[:1] @ turned(2.0), sweep(1)]))
    sparse_map, _ = mapped(replace(scene, T_gc=scene.T_gc[:3]))
    places = SimpleNamespace(words=scene.words, query=lambda vector: (np.array([1, 2, 0]), np.array([0.9, 0.8, 0.7])))
    frame = scene.frames(SENSOR)[3]
    found = [
        Relocalizer(sparse_map, places, scene.words, TrackConfig(relocalize_candidates=n), np.random.default_rng(0)).find(3, frame)
        for n in (2, 3)
    ]
    assert found[0] is None and found[1] is not None


def turned(angle: float) -> np.ndarray:
    return se3.exp(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0]))


@pytest.mark.shows("track.relocalize_inliers")
def test_a_place_is_recognized_by_so_many_landmarks() -> None:
    scene = seen(n=12, blind=range(6, 9))
    lost = [(tracked(scene, relocalize_inliers=n, segment_after=0).tracks().state[9:] == LOST).all() for n in (45, 10000)]
    assert lost == [False, True]


@pytest.mark.shows("track.moving_objects")
@pytest.mark.parametrize("is_on", [True, False])
def test_what_moves_is_looked_for_or_not(is_on: bool, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(track_stage.moving_parts, "are_any", lambda *given: bool(asked.append(given)))
    monkeypatch.setattr(track_stage.moving_parts, "still", lambda inputs, moving: (scene.features, inputs.depth))
    scene = seen(n=3)
    from scene_run import Run

    run = Run(scene, tmp_path)
    run.cfg.track = TrackConfig(moving_objects=is_on)
    track_stage.run(run, tmp_path, run.cfg, run)
    assert len(asked) == is_on and len(NOTHING.moving) == 0


@pytest.mark.shows("track.rests")
@pytest.mark.parametrize("is_on", [True, False])
def test_where_the_camera_stands_still_it_is_tracked_once_or_throughout(is_on: bool, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scene_run import Run

    from slamcli import artifacts
    from slamcli.schema import Rests, Tracks

    scene = seen(n=5)
    monkeypatch.setattr(track_stage.moving_parts, "still", lambda inputs, moving: (scene.features, inputs.depth))
    monkeypatch.setattr(track_stage.rests, "find", lambda *given: Rests(np.array([[1, 3]], np.int32)))
    run = Run(scene, tmp_path)
    run.cfg.track = TrackConfig(rests=is_on, moving_objects=False)
    track_stage.run(run, tmp_path, run.cfg, run)
    T_kc, ref_kf = artifacts.load(Tracks, tmp_path).T_kc, artifacts.load(Tracks, tmp_path).ref_kf
    assert (ref_kf[1] == ref_kf[2] and (T_kc[1] == T_kc[2]).all()) == is_on


# track: the map grows


@pytest.mark.shows("track.share_key_frames")
def test_new_landmarks_are_looked_for_in_so_many_key_frames() -> None:
    n_seen = [shared(share_key_frames=n) for n in (0, 2, 10)]
    assert n_seen[0] == 0 < n_seen[1] < n_seen[2]


@pytest.mark.shows("track.share_max_distance")
def test_descriptors_that_differ_more_are_not_one_landmark() -> None:
    assert shared(share_max_distance=1) < 0.1 * shared(share_max_distance=50)


def shared(**settings) -> int:
    """Let a fifth key frame join whose landmarks the others see but do not know; return how many views they gain."""
    scene = seen(n=6)
    sparse_map, growth = mapped(replace(scene, T_gc=scene.T_gc[:5]), **settings)
    frame = scene.frames(SENSOR)[5]
    known = np.full(len(frame), -1, np.int32)
    id_of = {int(scene.landmark[row]): int(sparse_map.lm_of_row[row]) for row in range(scene.features.offset[5])}
    rows = np.arange(*scene.features.offset[5:7])
    known[::2] = [id_of.get(int(landmark), -1) for landmark in scene.landmark[rows][::2]]
    kf, added = growth.insert(5, frame, scene.T_gc[5], known, 0)
    before = int(sparse_map.lm.n_obs[: added.max() + 1].sum())
    alive = int(sparse_map.lm.is_alive[: added.max() + 1].sum())
    growth._share_with_neighbours(kf, added)
    after = int(sparse_map.lm.n_obs[: added.max() + 1].sum())
    return (alive - int(sparse_map.lm.is_alive[: added.max() + 1].sum())) + max(after - before, 0)


def window_error(**settings) -> tuple[int, float]:
    """Disturb key frames and let one of them settle; return how many were moved, and how far off they are [m]."""
    scene = seen(n=10)
    sparse_map, growth = mapped(scene, **settings)
    noise = se3.exp(np.random.default_rng(0).normal(0, 0.01, (10, 6)))
    sparse_map.kf.T_wk[1:] = sparse_map.kf.T_wk[1:] @ noise[1:]
    before = sparse_map.kf.T_wk.copy()
    growth._adjust_window(9)
    is_moved = (sparse_map.kf.T_wk != before).any(axis=(1, 2))
    return int(is_moved.sum()), float(np.linalg.norm(sparse_map.kf.T_wk[is_moved, :3, 3] - scene.T_gc[is_moved, :3, 3], axis=1).mean())


@pytest.mark.shows("track.window_key_frames")
def test_a_wider_window_adjusts_more_key_frames() -> None:
    narrow, wide = (window_error(window_key_frames=n)[0] for n in (3, 9))
    assert narrow <= 3 < wide <= 9


@pytest.mark.shows("track.window_iterations")
def test_more_rounds_bring_the_window_nearer_to_the_truth() -> None:
    assert window_error(window_iterations=20)[1] < 0.95 * window_error(window_iterations=1)[1]
