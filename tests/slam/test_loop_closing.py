"""Loops: true revisits are found and pull drift out, look-alikes and unverifiable ones are rejected with a reason; final refinement."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import ape, observe, orbit, room_points

from slamcli.config.options import LoopConfig, SensorConfig, TrackConfig
from slamcli.console import silent
from slamcli.geometry import se3
from slamcli.schema import LOST, frame_poses
from slamcli.slam import final_refinement, frame_refinement, loop_candidates, loop_pose_graph, loop_verification
from slamcli.slam.loop_candidates import Candidate, Claims
from slamcli.slam.loop_closing import LoopCloser
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.slam.recording import TrackedRecording
from slamcli.slam.tracker import Tracker
from slamcli.sparse_map.sparse_map import SparseMap

SENSOR, SETTINGS = SensorConfig(pixel_noise=0.5), LoopConfig()


@pytest.fixture(scope="module")
def turn():
    """A turn and a bit inside a round room, tracked."""
    rng = np.random.default_rng(0)
    scene = observe(orbit(150, turns=1.1), room_points(9000, rng), rng)
    tracker = Tracker(scene.recording(SENSOR), TrackConfig(), np.random.default_rng(0))
    for i in range(150):
        tracker.process(i)
    assert (tracker.tracks().state != LOST).all()
    return scene, tracker.tracks(), tracker.map()


def drifted(scene, map_, per_key_frame: np.ndarray) -> SparseMap:
    """Rebuild the map with an error that grows from key frame to key frame, landmarks and all."""
    sparse_map = SparseMap.from_map(scene.features, map_)
    T_wk = sparse_map.kf.T_wk.copy()
    for k in range(1, len(T_wk)):
        step = se3.inverse(map_.T_wk[k - 1]) @ map_.T_wk[k] @ se3.exp(per_key_frame)
        T_wk[k] = T_wk[k - 1] @ step
    loop_pose_graph.move(sparse_map, T_wk)
    return sparse_map


def verified(scene, sparse_map) -> list[Candidate]:
    places = PlaceIndex(scene.words, sparse_map.kf.frame)
    rng = np.random.default_rng(1)
    candidates = loop_candidates.find_alike(sparse_map, places, SETTINGS)
    return [loop_verification.verify(sparse_map, scene.words, c, scene.frames(SENSOR), SETTINGS, rng) for c in candidates]


def test_similarity_is_symmetric_and_one_for_itself(turn):
    scene, _, map_ = turn
    places = PlaceIndex(scene.words, map_.kf_frame)
    scores = np.array([places.scores(k) for k in range(len(map_.kf_frame))])
    np.testing.assert_allclose(np.diag(scores), 1.0, atol=1e-5)
    np.testing.assert_allclose(scores, scores.T, atol=1e-6)


def test_every_accepted_closure_is_true_and_the_revisit_is_found(turn):
    scene, _, map_ = turn
    sparse_map = drifted(scene, map_, np.array([0.002, 0.001, 0.0, 0.0, 0.0005, 0.0]))
    accepted = [c for c in verified(scene, sparse_map) if c.is_accepted]
    assert any(c.kf_i > 0.9 * len(sparse_map.kf) and c.kf_j < 0.15 * len(sparse_map.kf) for c in accepted)
    true = scene.T_gc[map_.kf_frame]
    for c in accepted:
        error = se3.log(se3.inverse(se3.inverse(true[c.kf_i]) @ true[c.kf_j]) @ c.T_ij)
        assert np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[3:]) < 0.02


def test_closing_takes_the_drift_out(turn):
    scene, _, map_ = turn
    sparse_map = drifted(scene, map_, np.array([0.003, 0.001, 0.0, 0.0, 0.001, 0.0]))
    true = scene.T_gc[map_.kf_frame]
    before = ape(sparse_map.kf.T_wk, true)
    n_landmarks = int(sparse_map.lm.is_alive.sum())
    closer = LoopCloser(sparse_map, scene.words, scene.frames(SENSOR), SETTINGS, np.random.default_rng(1))
    tried = closer.close_loops(silent)
    after = ape(sparse_map.kf.T_wk, true)
    assert any(c.is_accepted for c in tried) and [(c.kf_i, c.kf_j) for c in tried] == sorted(closer.fate)
    assert 50 < n_landmarks - sparse_map.lm.is_alive.sum() < 0.5 * n_landmarks, "what both sides see is one landmark now"
    assert before > 0.02 and 1e-4 < after < before / 3


def test_a_lone_true_closure_outlasts_a_drift_of_five_degrees(turn):
    scene, _, map_ = turn
    sparse_map = drifted(scene, map_, 4.0 * np.array([0.003, 0.001, 0.0, 0.0, 0.001, 0.0]))
    far = [c for c in verified(scene, sparse_map) if c.is_accepted and c.kf_i - c.kf_j > len(sparse_map.kf) // 2][:1]
    T_ij = se3.inverse(sparse_map.kf.T_wk[far[0].kf_i]) @ sparse_map.kf.T_wk[far[0].kf_j]
    assert 4.0 < np.degrees(np.linalg.norm(se3.log(T_ij @ se3.inverse(far[0].T_ij))[3:])) < 7.0
    graph = loop_pose_graph.solve(sparse_map, far, SETTINGS)
    true = scene.T_gc[map_.kf_frame]
    assert graph.is_kept.all() and ape(graph.T_wk, true) < 0.8 * ape(sparse_map.kf.T_wk, true)


def test_a_planted_false_closure_is_dropped(turn):
    scene, _, map_ = turn
    sparse_map = SparseMap.from_map(scene.features, map_)
    accepted = [c for c in verified(scene, sparse_map) if c.is_accepted]
    n = len(sparse_map.kf)
    false = Candidate(n // 2, 2, 0.4, 100, 200, T_ij=se3.exp(np.array([0.4, 0.1, 0.2, 0.0, 0.3, 0.0])))
    honest, fooled = loop_pose_graph.solve(sparse_map, accepted, SETTINGS), loop_pose_graph.solve(sparse_map, [*accepted, false], SETTINGS)
    assert not fooled.is_kept[-1]
    true = scene.T_gc[map_.kf_frame]
    assert ape(fooled.T_wk, true) < 1.1 * ape(honest.T_wk, true)


def test_rejected_candidates_say_why(turn):
    scene, _, map_ = turn
    sparse_map = SparseMap.from_map(scene.features, map_)
    strangers = Candidate(len(sparse_map.kf) // 2, 0, 0.9)
    rng = np.random.default_rng(2)
    fate = loop_verification.verify(sparse_map, scene.words, strangers, scene.frames(SENSOR), SETTINGS, rng)
    assert not fate.is_accepted and "of 20 matches" in fate.reason


def test_final_refinement_finds_lost_frames_and_keeps_the_rest(turn):
    scene, tracks, map_ = turn
    tracks = replace(tracks, **{name: getattr(tracks, name).copy() for name in ("state", "ref_kf", "T_kc")})
    tracks.state[40:44], tracks.ref_kf[40:44], tracks.T_kc[40:44] = LOST, -1, np.nan
    sparse_map = SparseMap.from_map(scene.features, map_)
    after = frame_refinement.refine_frames(sparse_map, TrackedRecording(scene.frames(SENSOR), tracks), TrackConfig(), silent)
    assert (after.state != LOST).all()
    error = [ape(frame_poses(t, map_), scene.T_gc) for t in (tracks, after)]
    assert 1e-4 < error[1] < error[0] + 0.001


def test_final_refinement_finds_the_same_with_any_number_of_threads(turn):
    scene, tracks, map_ = turn
    found = []
    for workers in (1, 2, 4):
        sparse_map = SparseMap.from_map(scene.features, map_)
        look = (sparse_map, TrackedRecording(scene.frames(SENSOR), tracks), TrackConfig(), silent)
        found.append(frame_refinement.refine_frames(*look, workers=workers))
    assert (found[0].T_kc != tracks.T_kc).any()
    for other in found[1:]:
        for name in ("ref_kf", "T_kc", "state", "n_inliers"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))


def test_frames_of_one_key_frame_are_refined_together_whenever_they_were(turn, monkeypatch):
    scene, tracks, map_ = turn
    back_and_forth = replace(tracks, ref_kf=np.arange(len(tracks.ref_kf), dtype=np.int32) % 2 * tracks.ref_kf)
    asked, covisible = [], SparseMap.covisible
    monkeypatch.setattr(SparseMap, "covisible", lambda self, kf: (asked.append(kf), covisible(self, kf))[1])
    look = (SparseMap.from_map(scene.features, map_), TrackedRecording(scene.frames(SENSOR), back_and_forth), TrackConfig(), silent)
    frame_refinement.refine_frames(*look)
    n_frames = np.bincount(back_and_forth.ref_kf)
    assert n_frames[0] > 1
    assert len(asked) == sum(-(-n // frame_refinement.AT_ONCE) for n in n_frames), "once for so many frames of a key frame"


def test_final_refinement_matches_key_frames_again_and_the_world_stays_where_it_is(turn):
    scene, tracks, map_ = turn
    sparse_map = SparseMap.from_map(scene.features, map_)
    rng = np.random.default_rng(5)
    noise = se3.exp(rng.normal(0, [0.01, 0.01, 0.01, 0.004, 0.004, 0.004], (len(sparse_map.kf), 6)))
    noise[0] = np.eye(4)
    sparse_map.kf.T_wk[:] = sparse_map.kf.T_wk @ noise
    shaken = sparse_map.kf.T_wk.copy()
    found = frame_refinement.refine_frames(sparse_map, TrackedRecording(scene.frames(SENSOR), tracks), TrackConfig(), silent)
    assert (sparse_map.kf.T_wk == shaken).all(), "to refine frames leaves the map as it is"
    seen, landmarks = frame_poses(found, sparse_map.snapshot()), sparse_map.snapshot().lm_xyz
    after = final_refinement.move_key_frames(sparse_map, found)
    moved = sparse_map.snapshot()
    assert (after.T_kc[moved.kf_frame] == np.eye(4)).all()
    assert np.abs(sparse_map.kf.T_wk[0] - shaken[0]).max() < 1e-12
    shift = shaken[0] @ se3.inverse(seen[moved.kf_frame[0]])
    assert np.nanmax(np.abs(frame_poses(after, moved) - shift @ seen)) < 1e-12
    assert np.abs(moved.lm_xyz - se3.transform(shift, landmarks)).max() < 1e-5
    error = [ape(T_wk, map_.T_wk) for T_wk in (shaken, moved.T_wk)]  # of what landmarks hold, which drift does not touch
    assert error[0] > 0.01 and 1e-5 < error[1] < 0.2 * error[0]


@pytest.mark.shows("track.depth_icp_below")
def test_a_key_frame_that_depth_held_keeps_its_pose(turn):
    scene, tracks, map_ = turn
    most = int(tracks.n_inliers.max())
    found = [
        frame_refinement.refine_frames(
            SparseMap.from_map(scene.features, map_), TrackedRecording(scene.frames(SENSOR), tracks),
            replace(TrackConfig(), depth_icp_below=least), silent,
        )
        for least in (10 * most, 0)
    ]  # fmt: skip
    is_kept = [(f.T_kc[map_.kf_frame] == tracks.T_kc[map_.kf_frame]).all(axis=(1, 2)) for f in found]
    assert is_kept[0].all() and not is_kept[1].all()
    assert (found[0].T_kc != tracks.T_kc).any(), "other frames are refined all the same"


def test_views_of_one_spot_are_found_by_their_poses(turn):
    scene, _, map_ = turn
    true = scene.T_gc[map_.kf_frame]
    sparse_map = drifted(scene, map_, np.array([0.001, 0.0, 0.0, 0.0, 0.0003, 0.0]))
    places = PlaceIndex(scene.words, sparse_map.kf.frame)
    near = loop_candidates.find_by_pose(sparse_map, places, SETTINGS)
    spot = sparse_map.kf.T_wk[:, :3, 3] + loop_candidates.AHEAD * sparse_map.kf.T_wk[:, :3, 2]
    for c in near:
        assert c.is_by_pose and c.kf_j < c.kf_i and np.linalg.norm(spot[c.kf_i] - spot[c.kf_j]) < SETTINGS.near
        assert sparse_map.votes(sparse_map.landmarks_of(c.kf_i))[c.kf_j] < SETTINGS.min_shared
    fate = [loop_verification.verify(sparse_map, scene.words, c, scene.frames(SENSOR), SETTINGS, np.random.default_rng(0)) for c in near]
    accepted = [c for c in fate if c.is_accepted]
    assert any(c.kf_i > 0.9 * len(true) and c.kf_j < 0.15 * len(true) for c in accepted)
    for c in accepted:
        error = se3.log(se3.inverse(se3.inverse(true[c.kf_i]) @ true[c.kf_j]) @ c.T_ij)
        assert np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[3:]) < 0.02
    sparse_map.kf.segment[len(true) // 2 :] = 1
    half = len(true) // 2
    assert all((c.kf_i < half) == (c.kf_j < half) for c in loop_candidates.find_by_pose(sparse_map, places, SETTINGS))


def test_no_spot_is_near_at_a_reach_of_zero(turn):
    scene, _, map_ = turn
    sparse_map = SparseMap.from_map(scene.features, map_)
    assert loop_candidates.find_by_pose(sparse_map, PlaceIndex(scene.words, sparse_map.kf.frame), LoopConfig(near=0.0)) == []


@pytest.mark.parametrize("span", [0, 3, 10])
def test_claims_cover_what_is_near_any_of_them(span):
    rng = np.random.default_rng(span)
    pairs = [Candidate(int(i), int(j), 0.5) for i, j in rng.integers(0, 60, (150, 2))]
    claims, kept = Claims(pairs[:10], span=span), pairs[:10]
    for c in pairs[10:]:
        is_near = any(loop_candidates.is_same_revisit(c, other, span=span) for other in kept)
        assert claims.cover(c) == is_near
        if not is_near:
            claims.add(c)
            kept.append(c)
    assert 10 < len(kept) <= len(pairs)
    assert loop_candidates.first_of_each_revisit(pairs[10:], span=span)[0] is pairs[10]


def test_a_closure_needs_as_much_evidence_as_asked_for_and_no_more(turn):
    scene, _, map_ = turn
    sparse_map = SparseMap.from_map(scene.features, map_)
    found = next(c for c in verified(scene, sparse_map) if c.is_accepted)
    pair = Candidate(found.kf_i, found.kf_j, found.score)

    def again(**least) -> Candidate:
        rng = np.random.default_rng(1)
        return loop_verification.verify(sparse_map, scene.words, pair, scene.frames(SENSOR), replace(SETTINGS, **least), rng)

    n_matches, n_inliers = again().n_matches, again().n_inliers
    assert again(min_matches=n_matches, min_inliers=n_inliers).is_accepted
    assert again(min_matches=n_matches + 1).reason == f"{n_matches} of {n_matches + 1} matches"
    short = again(min_inliers=n_inliers + 1)
    assert not short.is_accepted and short.T_ij is None and "landmarks" in short.reason
    n_found = again(min_inliers=1000).n_inliers  # in the first, wide windows
    assert again(min_inliers=n_found + 1).reason == f"{n_found} of {n_found + 1} landmarks found again"
    assert f"{n_found} of" not in again(min_inliers=n_found).reason, "they are enough to look on"


@pytest.mark.parametrize("side", ["kf_i", "kf_j"])
def test_matches_count_where_both_have_depth(turn, side):
    scene, _, map_ = turn
    sparse_map = SparseMap.from_map(scene.features, map_)
    found = next(c for c in verified(scene, sparse_map) if c.is_accepted)
    depth = scene.features.depth.copy()
    rows = sparse_map.rows_of(getattr(found, side))
    depth[rows][np.arange(rows.stop - rows.start) % 8 > 0] = np.nan
    frames = replace(scene.frames(SENSOR), features=replace(scene.features, depth=depth))
    pair = Candidate(found.kf_i, found.kf_j, found.score)
    fate = loop_verification.verify(sparse_map, scene.words, pair, frames, replace(SETTINGS, min_matches=4), np.random.default_rng(1))
    assert 4 <= fate.n_matches < 0.25 * found.n_matches
