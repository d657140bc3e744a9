"""What tracking decides from frame to frame: where a map begins, what a key frame is, what a lost frame leads to, what predicts."""

from types import SimpleNamespace

import numpy as np
import pytest
from scenes import RATE, Scene, observe, orbit, room_points, sweep

from slamcli.config.options import SensorConfig, TrackConfig
from slamcli.geometry import se3
from slamcli.schema import KEY_FRAME, LOST, ON_DEPTH, RELOCALIZED, TRACKED, Rests, frame_poses, frame_segments
from slamcli.slam import background_prior, initial_pose, localizer
from slamcli.slam.depth_localization import DepthLocalizer, DepthMatch
from slamcli.slam.key_frames import BEGINS_SEGMENT, FOR_DEPTH, KeyFrameRule
from slamcli.slam.localizer import KnownMap, Localizer, nothing_seen
from slamcli.slam.recording import NOTHING_KNOWN, KnownMotion
from slamcli.slam.tracker import Tracker

SENSOR = SensorConfig(pixel_noise=0.5)
NO_CROWD = 10**6


def seen(T_gc: np.ndarray, *, seed: int = 0, **settings) -> Scene:
    rng = np.random.default_rng(seed)
    return observe(T_gc, room_points(2500, rng), rng, per_frame=200, **settings)


def track(scene: Scene, *, motion: KnownMotion = NOTHING_KNOWN, until: int | None = None, **settings) -> Tracker:
    tracker = Tracker(scene.recording(SENSOR), TrackConfig(**settings), np.random.default_rng(0), motion=motion)
    for i in range(len(scene.T_gc) if until is None else until):
        tracker.process(i)
    return tracker


def test_another_rule_decides_on_key_frames_and_the_reasons_are_counted():
    scene = seen(sweep(11, length=0.1))
    rule = KeyFrameRule(by_landmarks=lambda seen, _: "third frame" if seen.frames_since >= 3 else "")
    tracker = Tracker(scene.recording(SENSOR), TrackConfig(), np.random.default_rng(0), rule=rule)
    for i in range(11):
        tracker.process(i)
    assert tracker.map().kf_frame.tolist() == [0, 3, 6, 9]
    assert tracker.key_frame_reasons == {BEGINS_SEGMENT: 1, "third frame": 3}


def test_a_map_begins_with_just_as_many_features_with_depth_as_wanted():
    scene = seen(sweep(2))
    scene.features.depth[::3] = np.nan
    n, n_depth = len(scene.frames(SENSOR)[0]), int(np.isfinite(scene.frames(SENSOR)[0].depth).sum())
    assert track(scene, until=1, start_features=n_depth).tracks().state[0] == KEY_FRAME
    tracker = track(scene, until=1, start_features=n_depth + 1)
    assert tracker.tracks().state[0] == LOST
    assert f"{n} features, {n_depth} with depth, {n_depth + 1} wanted" in tracker.lost_reason[0]


@pytest.mark.parametrize("gap", [1, 3, 4])
def test_where_nothing_else_asks_for_one_a_key_frame_is_made_each_time_the_gap_is_over(gap: int):
    tracker = track(seen(sweep(13)), key_frame_gap=gap, key_frame_share=0.0, key_frame_crowd=NO_CROWD)
    assert tracker.map().kf_frame.tolist() == list(range(0, 13, gap))
    assert (tracker.tracks().state == np.where(np.arange(13) % gap, TRACKED, KEY_FRAME)).all()


def test_a_frames_reference_is_the_key_frame_that_shares_the_most_with_it():
    path = sweep(10)
    tracker = track(seen(np.concatenate([path, path[::-1]])), key_frame_gap=3, key_frame_share=0.0, key_frame_crowd=2)
    votes = tracker._sparse_map.votes(tracker._previous.landmark[tracker._previous.landmark >= 0])
    last = tracker.tracks().ref_kf[-1]
    assert tracker.tracks().state[-1] == TRACKED and votes[last] == votes.max() > 50 and last != len(votes) - 1


def test_the_rule_is_told_what_a_frame_sees_of_what():
    scene = seen(sweep(8))
    scene.features.depth[::5] = np.nan
    tracker = track(scene, key_frame_gap=4, key_frame_share=0.0, key_frame_crowd=NO_CROWD, until=7)
    frame, landmark = tracker._previous.features, tracker._previous.landmark
    has_depth = np.isfinite(frame.depth)
    sighting = tracker._sighting(6, frame, landmark)
    assert sighting.n_landmarks == (landmark >= 0).sum() > 50
    assert sighting.frames_since == 6 - tracker.map().kf_frame[-1] > 0
    assert 0 < sighting.n_near_landmarks < sighting.n_landmarks
    assert sighting.n_near_landmarks + sighting.n_near_new == has_depth.sum()
    assert sighting.n_near_new == has_depth[landmark < 0].sum()
    assert tracker._sighting(6, frame, np.zeros_like(landmark)).n_landmarks == len(landmark), "the first landmark counts like any other"
    sparse_map = tracker._sparse_map
    of_reference = sparse_map.landmarks_of(int(tracker.tracks().ref_kf[6]))
    assert sighting.n_reference == (sparse_map.lm.n_obs[of_reference] >= 2).sum() < len(of_reference)
    here = sparse_map.kf.T_wk[:, :3, 3] - frame_poses(tracker.tracks(), tracker.map())[6, :3, 3]
    assert sighting.n_crowd == (np.linalg.norm(here, axis=1) < 0.1).sum()


def test_of_the_only_key_frame_all_landmarks_count_and_another_segments_crowd_does_not():
    tracker = track(seen(np.repeat(sweep(2)[:1], 3, axis=0)), until=2)
    frame, landmark = tracker._previous.features, tracker._previous.landmark
    sighting = tracker._sighting(1, frame, landmark)
    assert sighting.n_reference == len(tracker._sparse_map.landmarks_of(0)) > 150 and sighting.n_crowd == 1
    tracker._sparse_map.add_key_frame(0, np.eye(4), segment=1)
    assert tracker._sighting(1, frame, landmark).n_crowd == 1


def resting(*, first: int = 4, blind: tuple[int, ...] = ()) -> tuple[Scene, KnownMotion]:
    """A sweep of twelve frames with a rest from frame `first` to frame 8."""
    path = sweep(12)
    path[first + 1 : 9] = path[first]
    return seen(path, blind=blind), KnownMotion(stands_still=Rests(np.array([[first, 8]], np.int32)))


def test_the_last_frame_of_a_rest_is_located_for_the_landmarks_that_the_next_one_is_tracked_by():
    scene, motion = resting()
    within, last = (track(scene, motion=motion, until=n)._previous.landmark for n in (8, 9))
    assert (within < 0).all() and (last >= 0).sum() > 50


@pytest.mark.parametrize("blind", [(4,), (5, 6, 7), (7,)])
def test_where_a_rest_begins_lost_its_frames_are_looked_for(blind: tuple[int, ...]):
    """None is said to stand where a lost one does, neither within the rest nor at its end."""
    scene, motion = resting(first=blind[0], blind=blind)
    tracks, after = track(scene, motion=motion).tracks(), blind[-1] + 1
    assert (tracks.state[list(blind)] == LOST).all() and (tracks.state[after:] != LOST).all()
    assert (tracks.ref_kf[after:] >= 0).all() and np.isfinite(tracks.T_kc[after:]).all()


def lost_and_back(*parts: tuple[str, int], blind: bool = False) -> tuple[Scene, np.ndarray]:
    """Frames in a known place ("here"), in another ("there") that was never seen, and which are dark, in this order."""
    here = orbit(60, turns=0.1)
    poses, dark, k = [], [], 0
    for where, n in parts:
        for _ in range(n):
            poses.append(here[k] if where == "here" else se3.exp(np.array([0, 0, 0, 0, 0, np.pi])) @ here[k])
            if where == "dark":
                dark.append(len(poses) - 1)
            k += 1
    return seen(np.array(poses), blind=tuple(dark)), np.array([where for where, n in parts for _ in range(n)])


def test_lost_frames_count_from_the_last_one_that_was_found():
    scene, where = lost_and_back(("here", 8), ("there", 4), ("here", 3), ("there", 4))
    tracker = track(scene, segment_after=5)
    state = tracker.tracks().state
    np.testing.assert_array_equal(state == LOST, where == "there")
    assert state[12] in (RELOCALIZED, KEY_FRAME) and tracker.map().kf_segment.max() == 0


def test_a_dark_frame_could_not_be_recognized_and_does_not_count():
    scene, where = lost_and_back(("here", 8), ("there", 2), ("dark", 5), ("there", 2))
    assert track(scene, segment_after=5).map().kf_segment.max() == 0
    tracker = track(scene, segment_after=4)
    segment = frame_segments(tracker.tracks(), tracker.map())
    assert segment.tolist() == [0] * 8 + [1] * 2 + [-1] * 5 + [1] * 2, "and the segment begins with the first that was lost"
    assert tracker.tracks().state[8] == KEY_FRAME and len(np.unique(tracker.map().kf_frame)) == len(tracker.map().kf_frame)
    assert set(tracker.lost_reason) == set(np.flatnonzero(where == "dark").tolist())
    assert all(reason == "0 features: blank or unreadable image" for reason in tracker.lost_reason.values())


def test_only_before_there_is_a_map_is_a_frame_told_that_there_is_none():
    scene, _ = lost_and_back(("here", 8), ("there", 4))
    scene.features.depth[scene.features.offset[8] :] = np.nan  # nothing to begin another segment with
    tracker = track(scene, segment_after=2)
    assert tracker.tracks().state[8:].tolist() == [LOST] * 4 and tracker.map().kf_segment.max() == 0
    assert all("agree with the map" in tracker.lost_reason[i] for i in range(8, 12))


def test_what_agrees_with_too_little_of_the_map_is_told_so():
    scene, _ = lost_and_back(("here", 5), ("there", 1))
    n = len(scene.frames(SENSOR)[5])
    assert track(scene).lost_reason == {5: f"fewer than 15 of {n} features agree with the map"}


def test_after_a_frame_of_which_no_landmark_is_known_those_of_its_reference_are_looked_for():
    T_gc = sweep(8, length=0.1)
    T_gc[6:] = T_gc[6:] @ se3.exp(np.array([0, 0, 0, 0, 0.1, 0]))  # 50 px: only what was matched, and lifted by depth, tells where they are
    tracker = track(seen(T_gc), until=6, relocalize_inliers=NO_CROWD)
    tracker._previous.remember(tracker._previous.features, nothing_seen(tracker._previous.features))
    tracker._sparse_map.add_key_frame(7, np.eye(4), segment=1)  # the last key frame is another, and sees nothing
    tracker.process(6)
    tracks = tracker.tracks()
    assert tracks.state[6] != LOST and tracks.n_inliers[6] > 0.5 * tracks.n_inliers[5]


def test_the_reference_whose_landmarks_are_looked_for_is_that_of_the_frame_before():
    tracker = track(seen(sweep(6)), until=4, key_frame_gap=3, key_frame_share=0.0)
    ref = tracker.tracks().ref_kf
    assert ref[3] != ref[2]
    known = tracker._localizer._still_known(4, nothing_seen(tracker._previous.features))
    np.testing.assert_array_equal(known, tracker._sparse_map.landmarks_of(int(ref[3])))
    np.testing.assert_array_equal(tracker._localizer._still_known(4, np.array([7, -1, 3], np.int32)), [7, 3])


def test_a_frame_is_looked_for_where_the_last_motion_goes_on(monkeypatch):
    """That between the two frames before it, whatever the camera did earlier."""
    predicted, estimate = [], initial_pose.estimate
    monkeypatch.setattr(initial_pose, "estimate", lambda found, T_cw, *more: predicted.append(T_cw) or estimate(found, T_cw, *more))
    path = sweep(60)[np.cumsum([0, 1, 3, 2, 5, 1, 4, 6])]
    tracker = track(seen(path), key_frame_gap=NO_CROWD, key_frame_share=0.0)  # of a single key frame, so that no pose changes afterwards
    T_wc = frame_poses(tracker.tracks(), tracker.map())
    assert len(tracker.map().kf_frame) == 1 and len(predicted) == len(path) - 1
    for i in range(2, len(path)):
        np.testing.assert_allclose(se3.inverse(predicted[i - 1]), T_wc[i - 1] @ se3.inverse(T_wc[i - 2]) @ T_wc[i - 1], atol=1e-9)


def test_depth_is_asked_where_fewer_landmarks_hold_a_frame_than_are_wanted(monkeypatch):
    scene, asked = seen(sweep(3)), []
    monkeypatch.setattr(DepthLocalizer, "locate", lambda _, i, frame, found: asked.append((i, found.estimate.n_inliers)))
    n = int(track(scene, until=2, depth_icp_below=0).tracks().n_inliers[1])
    assert n > 50 and not asked
    track(scene, until=2, depth_icp_below=n)
    assert not asked
    track(scene, until=2, depth_icp_below=n + 1)
    assert asked == [(1, n)]


def test_what_was_seen_but_is_no_landmark_is_lifted_by_depth_where_the_frame_before_stood():
    T_gc, step = sweep(8, length=0.1), se3.exp(np.array([0, 0, 0, 0, 0.1, 0]))  # 50 px, so that another place of it would be told
    T_gc[5:] = T_gc[5:] @ step
    T_gc[6:] = T_gc[6:] @ step
    tracker = track(seen(T_gc), until=6, relocalize_inliers=NO_CROWD, key_frame_share=0.0)
    tracker._previous.remember(tracker._previous.features, nothing_seen(tracker._previous.features))
    tracker.process(6)
    tracks = tracker.tracks()
    assert tracks.state[6] == TRACKED and tracks.n_inliers[6] > 0.5 * tracks.n_inliers[5]


def test_once_a_recording_is_recognized_in_a_map_its_frames_are_followed_there():
    scene = seen(sweep(10), blind=(5,))
    tracker = track(scene)
    localizer = Localizer(KnownMap(tracker._sparse_map, tracker._places), scene.recording(SENSOR), TrackConfig(), np.random.default_rng(0))
    for i in range(10):
        localizer.process(i)
        n_remembered = np.count_nonzero(localizer.previous.landmark >= 0)
        assert n_remembered >= localizer.tracks().n_inliers[i] and (n_remembered > 50) == (i != 5), "the next frame is tracked by these"
    assert localizer.tracks().state.tolist() == [RELOCALIZED, *[TRACKED] * 4, LOST, RELOCALIZED, *[TRACKED] * 3]


def drifting(T_gc: np.ndarray) -> np.ndarray:
    """Return a background of true motion from frame to frame, but for a drift, in a world of its own."""
    T = [se3.exp(np.array([1.0, 2.0, 0.5, 0.3, -0.4, 0.2]))]
    for a, b in zip(T_gc, T_gc[1:], strict=False):
        T.append(T[-1] @ se3.inverse(a) @ b @ se3.exp(np.array([1e-3, 0, 0, 0, 2e-4, 0])))
    return np.array(T)


def test_the_background_joins_each_key_frame_that_few_landmarks_hold_to_the_one_before(monkeypatch):
    scene = seen(sweep(13))
    motion = KnownMotion(background=drifting(scene.T_gc))

    def mapped():
        return track(scene, motion=motion, key_frame_gap=4, key_frame_share=0.0, key_frame_crowd=NO_CROWD).map()

    assert len(mapped().edge_kf) == 0
    monkeypatch.setattr(background_prior, "ENOUGH", 10_000)
    map_ = mapped()
    assert map_.kf_frame.tolist() == [0, 4, 8, 12] and map_.edge_kf.tolist() == [[1, 0], [2, 1], [3, 2]]
    for (i, j), T_ij, information in zip(map_.edge_kf, map_.edge_T_ij, map_.edge_information, strict=True):
        T_wi, T_wj = motion.background[map_.kf_frame[[i, j]]]
        np.testing.assert_allclose(T_ij, se3.inverse(T_wi) @ T_wj, atol=1e-12)
        np.testing.assert_array_equal(information, background_prior.BETWEEN_KEY_FRAMES)


def test_a_key_frame_is_joined_by_the_background_within_its_segment_alone():
    scene, _ = lost_and_back(("here", 4), ("there", 8))
    motion = KnownMotion(background=np.tile(np.eye(4), (12, 1, 1)))
    tracker = track(scene, motion=motion, until=4)
    frame = scene.frames(SENSOR)[8]
    tracker._segment = 1
    for i in (8, 9):
        tracker._add_key_frame(i, scene.frames(SENSOR)[i], np.eye(4), nothing_seen(frame if i == 8 else scene.frames(SENSOR)[9]))
    map_ = tracker.map()
    segment = map_.kf_segment[map_.edge_kf]
    assert (segment[:, 0] == segment[:, 1]).all() and (segment == 1).all(axis=1).sum() == 1


def test_a_pose_is_weighed_against_the_motion_since_the_frame_before_and_since_a_moment_ago(monkeypatch):
    scene, earlier = seen(sweep(14)), []
    monkeypatch.setattr(background_prior, "contradicts", lambda found, expected, T_wp: earlier.append(T_wp))
    motion = KnownMotion(background=drifting(scene.T_gc))
    tracker = track(scene, motion=motion, key_frame_gap=NO_CROWD, key_frame_share=0.0)
    T_wc = frame_poses(tracker.tracks(), tracker.map())
    a_moment_ago = 13 - int(np.ceil(background_prior.LOOK_BACK * RATE))
    np.testing.assert_allclose(earlier[-2:], [T_wc[12], T_wc[a_moment_ago]], atol=1e-12)


def test_the_background_carries_on_from_the_first_frame_of_a_map():
    scene = seen(sweep(6), blind=(0, 1, 2, 4))
    state = track(scene, motion=KnownMotion(background=drifting(scene.T_gc))).tracks().state
    assert (state[:3] == LOST).all() and (state[3:] != LOST).all()


def test_where_no_landmark_holds_a_frame_the_background_carries_it_on():
    scene = seen(sweep(14), blind=(6, 7, 8))
    background = drifting(scene.T_gc)
    tracker = track(scene, motion=KnownMotion(background=background))
    tracks = tracker.tracks()
    assert (tracks.state != LOST).all() and (tracks.n_inliers[6:9] == 0).all() and (tracks.n_inliers[9:] > 30).all()
    T_wc = frame_poses(tracks, tracker.map())
    for i in (6, 7, 8):
        assert (
            np.abs(se3.log(se3.inverse(se3.inverse(T_wc[i - 1]) @ T_wc[i]) @ se3.inverse(background[i - 1]) @ background[i])).max() < 1e-9
        )
    carried = track(scene, motion=KnownMotion(background=background), until=9)
    assert tracker._poses.anchored >= 9 and carried._poses.anchored == 5
    assert carried._add_previous_as_key_frame(9) is None, "what was not measured is no key frame"
    assert not tracker.lost_reason


def test_the_frame_before_becomes_a_key_frame_once_and_only_where_its_pose_was_measured():
    tracker = track(seen(sweep(8, length=0.1), blind=(6,)), until=6, key_frame_share=0.0)
    assert tracker.tracks().state[5] == TRACKED
    made = tracker._add_previous_as_key_frame(6)
    assert tracker.key_frame_reasons[FOR_DEPTH] == 1
    assert made == 1 and tracker.map().kf_frame.tolist() == [0, 5] and tracker.tracks().state[5] == KEY_FRAME
    assert tracker._add_previous_as_key_frame(6) is None, "it is one already"
    tracker.process(6)
    assert tracker._add_previous_as_key_frame(7) is None, "that one is lost"
    assert tracker.map().kf_frame.tolist() == [0, 5]


def test_a_pose_is_weighed_against_the_motion_since_the_frame_before_alone():
    scene = seen(sweep(10, length=0.1))
    background = drifting(scene.T_gc)
    background[3:] = se3.exp(np.array([1.0, 0, 0, 0, 0, 0])) @ background[3:]  # it errs once
    state = track(scene, motion=KnownMotion(background=background), key_frame_share=0.0, key_frame_gap=100).tracks().state
    assert state[3] == RELOCALIZED and (np.delete(state, [0, 3]) == TRACKED).all()


def test_a_frame_that_depth_places_counts_the_landmarks_that_agree():
    tracker = track(seen(sweep(6, length=0.1)), until=5)
    landmark = np.array([4, -1, 0, -1, -1, 9, 2], np.int32)
    placement = SimpleNamespace(kf=0, T_cw=np.eye(4), alignment=SimpleNamespace(overlap=0.5))
    location = localizer._by_depth(DepthMatch(placement, landmark, is_anchored=False))
    tracker._poses.attach(5, location)
    tracks = tracker.tracks()
    assert (tracks.state[5], tracks.n_inliers[5], tracks.ref_kf[5]) == (ON_DEPTH, 4, 0) and tracker._poses.anchored == 4
    assert location.landmark is landmark and location.overlap == 0.5
