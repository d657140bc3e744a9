"""Rests: found where the camera stands still and nowhere else, one pose for all their frames, no key frame within."""

import numpy as np
import pytest
from scenes import CAMERA, Scene, ape, observe, room_points, sweep

from slamcli.config.options import SensorConfig, TrackConfig
from slamcli.console import silent
from slamcli.geometry import se3
from slamcli.schema import KEY_FRAME, LOST, Features, Rests, frame_poses
from slamcli.slam import frame_refinement, rests
from slamcli.slam.recording import KnownMotion, TrackedRecording
from slamcli.slam.tracker import Tracker
from slamcli.sparse_map.sparse_map import SparseMap

SENSOR = SensorConfig(pixel_noise=0.5, depth_noise_base=0.0012, depth_noise_quadratic=0.0019)
FIRST, LAST = 14, 63  # of the frames at rest in `resting`


def resting(seed: int = 1, *, pixel_noise: float = 0.3) -> Scene:
    """A sweep that pauses for 50 frames."""
    rng = np.random.default_rng(seed)
    moving = sweep(30)
    path = np.concatenate([moving[:FIRST], np.repeat(moving[FIRST : FIRST + 1], LAST - FIRST + 1, axis=0), moving[FIRST + 1 :]])
    return observe(path, room_points(4000, rng), rng, pixel_noise=pixel_noise)


def found_in(scene: Scene) -> list[list[int]]:
    return rests.find(scene.features, scene.words, scene.matches, CAMERA).rest_span.tolist()


@pytest.mark.parametrize("pixel_noise", [0.0, 0.15, 0.3])
def test_a_pause_is_found_to_the_frame(pixel_noise: float) -> None:
    assert found_in(resting(pixel_noise=pixel_noise)) == [[FIRST, LAST]]


@pytest.mark.parametrize(
    "twist",
    [(0.004, 0, 0, 0, 0, 0), (0, 0, 0.006, 0, 0, 0), (0, 0, 0, 0, 0, 0.002), (0, 0, 0, 0.001, 0, 0)],
    ids=["sideways", "forward", "about the view", "nodding"],
)
def test_slow_motion_is_no_rest(twist: tuple) -> None:
    """Per frame it is below what two images tell: 4 mm, 6 mm, 0.1 or 0.06 degrees a frame would be told at once, a twentieth not."""
    rng = np.random.default_rng(2)
    step = se3.exp(0.05 * np.array(twist, dtype=float))
    path = [sweep(2)[0]]
    for _ in range(90):
        path.append(path[-1] @ step)
    spans = found_in(observe(np.array(path), room_points(4000, rng), rng, pixel_noise=0.2))
    assert all(last - first < 45 for first, last in spans)  # what is called one rest moved by less than the noise of a single pose
    for first, last in spans:
        assert np.linalg.norm(se3.log(se3.inverse(path[first]) @ path[last])[:3]) < 0.012


def test_a_short_pause_and_a_blank_view_are_no_rest() -> None:
    rng = np.random.default_rng(3)
    still = np.repeat(sweep(2)[:1], 25, axis=0)  # 0.8 s
    assert found_in(observe(still, room_points(4000, rng), rng)) == []
    blank = observe(np.repeat(still, 3, axis=0), room_points(4000, rng), rng, per_frame=rests.LEAST_MATCHES - 1)
    assert found_in(blank) == []


def test_who_walks_along_is_no_rest_of_the_camera() -> None:
    """Half of the features keep their place in the image, as somebody's do who walks along: the others say that the camera moves."""
    scene = resting(pixel_noise=0.2)
    xy = np.array(scene.features.xy)
    frame = np.repeat(np.arange(len(scene.T_gc)), np.diff(scene.features.offset))
    away = scene.landmark % 2 == 0
    xy[away] += 3.0 * frame[away, None].astype(np.float32)
    features = Features(**{**vars(scene.features), "xy": xy})
    assert rests.find(features, scene.words, scene.matches, CAMERA).rest_span.tolist() == []


def track(scene: Scene, stands_still: Rests) -> Tracker:
    motion = KnownMotion(stands_still=stands_still)
    tracker = Tracker(scene.recording(SENSOR), TrackConfig(), np.random.default_rng(0), motion=motion)
    for i in range(len(scene.T_gc)):
        tracker.process(i)
    return tracker


def test_a_rest_adds_no_key_frame_and_tracking_goes_on_after_it() -> None:
    scene = resting()
    stands_still = Rests(np.array([[FIRST, LAST]], np.int32))
    tracker = track(scene, stands_still)
    tracks = tracker.tracks()
    assert (tracks.state != LOST).all()
    assert not (tracks.state[FIRST + 1 : LAST + 1] == KEY_FRAME).any() and (tracks.state[LAST + 1 :] == KEY_FRAME).any()
    T_wc = frame_poses(tracks, tracker.map())
    np.testing.assert_allclose(T_wc[FIRST + 1 : LAST], np.broadcast_to(T_wc[FIRST + 1], (LAST - FIRST - 1, 4, 4)), atol=1e-12)
    assert 1e-5 < ape(T_wc, scene.T_gc) < 0.004


def test_the_final_refinement_gives_a_rest_one_pose_better_than_a_single_frame_has() -> None:
    scene = resting()
    stands_still = Rests(np.array([[FIRST, LAST]], np.int32))
    error = {}
    for name, spans in (("one pose", stands_still), ("each its own", rests.NONE)):
        tracker = track(scene, stands_still)
        sparse_map, tracks = SparseMap.from_map(scene.features, tracker.map()), tracker.tracks()
        tracked = TrackedRecording(scene.frames(SENSOR), tracks, spans)
        after = frame_refinement.refine_frames(sparse_map, tracked, TrackConfig(), silent)
        T_wc = frame_poses(after, sparse_map.snapshot())[FIRST : LAST + 1]
        error[name] = np.linalg.norm(T_wc[:, :3, 3] - T_wc[:, :3, 3].mean(axis=0), axis=1).max()
    assert error["one pose"] < 1e-9 and 1e-4 < error["each its own"] < 0.01


def test_the_pose_of_a_rest_is_the_median_of_those_measured_and_leaves_the_lost_alone() -> None:
    rng = np.random.default_rng(4)
    T_wc = se3.exp(0.001 * rng.normal(size=(20, 6)))
    T_wc[7] = se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))  # an outlier
    T_wc[9] = np.nan
    segment = np.where(np.arange(20) == 9, -1, 0)
    after = rests.one_pose(Rests(np.array([[3, 15]], np.int32)), T_wc, np.arange(20) != 5, segment)
    np.testing.assert_array_equal(after[[0, 1, 2, 16, 19]], T_wc[[0, 1, 2, 16, 19]])
    assert np.isnan(after[9]).all() and np.linalg.norm(after[3, :3, 3]) < 0.001
    np.testing.assert_array_equal(after[7], after[3])


def test_of_a_long_rest_few_frames_are_looked_at() -> None:
    left_out = rests.left_out(Rests(np.array([[10, 209]], np.int32)), 300)
    assert (~left_out[10:210]).sum() == rests.SAMPLES and not left_out[[10, 209]].any() and not left_out[:10].any()
