"""Doubt about single poses: right ones are sure, wrong ones are not, and what a blind stretch may have torn apart is told."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from boxroom import FURNITURE, KINECT, look_along, render
from kinect import coded

from slamcli.depth import icp
from slamcli.geometry import se3
from slamcli.schema import TRACKED, Doubt, Map, Tracks
from slamcli.slam import depth_views, pose_doubt
from slamcli.slam.depth_views import Views

FRAMES, RATE = 40, 15.0
NOTHING = np.zeros((0, 0, 0), dtype=bool)


@cache
def room() -> tuple[Views, np.ndarray]:
    """A drive through the empty room; views with the true poses, and these."""
    T_wc = np.array([look_along([1.2 + 0.04 * i, 2.9, 0.9], 0.02 * np.sin(i / 5), 0.15) for i in range(FRAMES)])
    depth = coded([icp.coarsen(render(T, KINECT, boxes=FURNITURE)) for T in T_wc])
    return Views(depth, np.arange(FRAMES) / RATE, T_wc, np.zeros(FRAMES, dtype=np.int64), KINECT), T_wc


def found(
    T_wc: np.ndarray, n_inliers: np.ndarray | int = 200, ties: tuple[tuple[int, int], ...] = (), edges: tuple[tuple[int, int], ...] = ()
) -> tuple[Tracks, Map]:
    """Tracks of these poses, each frame a key frame; `ties` : pairs of frames that see the same 50 landmarks; `edges` : that are 3 mm sure."""
    n = len(T_wc)
    tracks = Tracks(
        ref_kf=np.arange(n, dtype=np.int32), T_kc=np.tile(np.eye(4), (n, 1, 1)), state=np.full(n, TRACKED, np.uint8),
        n_inliers=np.broadcast_to(n_inliers, n).astype(np.int32),
    )  # fmt: skip
    obs_kf = np.array([frame for pair in ties for _ in range(50) for frame in pair], np.int32)
    obs_lm = np.repeat(np.arange(len(obs_kf) // 2, dtype=np.int32), 2)
    frames = np.arange(n, dtype=np.int32)
    edge_kf = np.array(edges, dtype=np.int32).reshape(-1, 2)
    map_ = Map(
        frames, np.zeros(n, np.int32), T_wc, np.zeros((len(obs_kf) // 2, 3)), obs_lm, obs_kf, np.zeros(len(obs_kf), np.int64),
        edge_kf, np.tile(np.eye(4), (len(edges), 1, 1)), np.tile(3.0 / 0.003**2 * np.eye(6), (len(edges), 1, 1)),
    )  # fmt: skip
    return tracks, map_


def judged(T_wc: np.ndarray, *, first: np.ndarray | None = None, moving: np.ndarray = NOTHING, **held: object) -> Doubt:
    poses = found(T_wc, **held)
    return pose_doubt.judge(replace(room()[0], T_wc=T_wc), moving, moving, poses if first is None else found(first), poses)


def test_right_poses_are_sure() -> None:
    record = judged(room()[1])
    assert not record.is_doubtful.any() and (record.drift == 0.0).all() and (record.sigma < 0.01).all()
    assert pose_doubt.findings(record) == []


def test_a_camera_believed_to_rest_while_it_moves_is_contradicted_by_what_it_sees() -> None:
    record = judged(np.tile(np.eye(4), (FRAMES, 1, 1)))
    assert record.is_doubtful.mean() > 0.4
    (finding,) = pose_doubt.findings(record)
    assert finding.is_grave and "look through" in finding.text


def test_passes_that_disagree_about_a_jump_are_doubtful_around_it_and_nowhere_else() -> None:
    true = room()[1]
    first = true.copy()
    first[20:] = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])) @ first[20:]
    record = judged(true, first=first)
    assert record.is_doubtful[20:26].all() and not record.is_doubtful[:20].any() and not record.is_doubtful[30:].any()
    assert not pose_doubt.findings(record)[0].is_grave


def test_frames_that_few_landmarks_hold_are_doubtful_and_the_lost_have_no_sigma() -> None:
    few = np.where(np.arange(FRAMES) == 7, 5, 200)
    tracks, map_ = found(room()[1], n_inliers=few)
    ref_kf = tracks.ref_kf.copy()
    ref_kf[30] = -1
    poses = replace(tracks, ref_kf=ref_kf), map_
    record = pose_doubt.judge(room()[0], NOTHING, NOTHING, poses, poses)
    assert np.flatnonzero(record.is_doubtful).tolist() == [7, 30] and np.flatnonzero(np.isnan(record.sigma)).tolist() == [30]


SPARSE = np.where(np.isin(np.arange(FRAMES), range(25, 32)), pose_doubt.SHOWN - 1, 200)  # landmarks that hold each frame


def covered(frames: range) -> np.ndarray:
    """Masks in which most of the view moves in these frames."""
    moving = np.zeros((FRAMES, *depth_views.shape(KINECT)), dtype=bool)
    moving[frames.start : frames.stop, :, :-8] = True
    return moving


def test_what_lies_beyond_a_stretch_without_a_static_world_is_doubtful_too() -> None:
    record = judged(room()[1], moving=covered(range(25, 32)), n_inliers=SPARSE)
    assert not record.is_doubtful[:25].any() and record.is_doubtful[25:].all()
    assert record.drift[-1] == pytest.approx(np.sqrt(8) * pose_doubt.STEP_BLIND, rel=0.05)


def test_what_lies_beyond_views_that_mostly_move_is_sure_where_many_landmarks_hold_them() -> None:
    record = judged(room()[1], moving=covered(range(25, 32)), n_inliers=pose_doubt.SHOWN)
    assert np.flatnonzero(record.is_doubtful).tolist() == list(range(25, 32)) and record.drift.max() < pose_doubt.STEP_BLIND


def test_landmarks_seen_before_and_after_tie_both_sides_together() -> None:
    record = judged(room()[1], moving=covered(range(25, 32)), n_inliers=SPARSE, ties=((20, 35),))
    assert record.is_doubtful[25:32].all() and not record.is_doubtful[:25].any() and not record.is_doubtful[33:].any()
    assert record.drift.max() < np.sqrt(4) * pose_doubt.STEP_BLIND + 0.01


def test_few_landmarks_drift_only_where_things_move() -> None:
    weak = np.where(np.arange(FRAMES) >= 25, 16, 200)
    moving = np.zeros((FRAMES, *depth_views.shape(KINECT)), dtype=bool)
    moving[:, :3, :3] = True
    drift = judged(room()[1], n_inliers=weak, moving=moving).drift
    assert (
        drift.max() == pytest.approx(np.sqrt(15) * pose_doubt.STEP_WORST, rel=0.1) and (judged(room()[1], n_inliers=weak).drift == 0).all()
    )


def test_edges_hold_what_few_landmarks_hold_but_not_past_frames_that_see_no_static_world() -> None:
    weak = np.where(np.arange(FRAMES) >= 25, 16, 200)
    moving = np.zeros((FRAMES, *depth_views.shape(KINECT)), dtype=bool)
    moving[:, :3, :3] = True
    chain = ((31, 24), (31, 38))
    held = judged(room()[1], n_inliers=weak, moving=moving, edges=chain).drift
    assert held[38] ** 2 - held[24] ** 2 == pytest.approx(2 * 0.003**2, rel=0.01) and held.max() < 4 * pose_doubt.STEP_WORST
    moving[28, :, :-8] = True
    past = judged(room()[1], n_inliers=weak, moving=moving, edges=chain).drift
    assert past[38] > pose_doubt.STEP_BLIND


@pytest.mark.parametrize(("n_doubtful", "n_lost", "is_grave"), [(7, 0, False), (8, 0, True), (7, 5, True), (7, 4, False)])
def test_a_fifth_of_the_poses_in_doubt_puts_the_run_in_doubt_and_the_lost_have_none(n_doubtful: int, n_lost: int, is_grave: bool) -> None:
    record = judged(room()[1])
    sigma, is_doubtful = record.sigma.copy(), np.arange(FRAMES) < n_doubtful
    sigma[FRAMES - n_lost :], is_doubtful[FRAMES - n_lost :] = np.nan, True
    record = replace(record, sigma=sigma, is_doubtful=is_doubtful)
    (finding,) = pose_doubt.findings(record)
    assert record.n_doubtful == n_doubtful and finding.is_grave == is_grave and f"{n_doubtful} of {FRAMES - n_lost} frames" in finding.text


@pytest.mark.parametrize(("contradicted", "is_told"), [(0.029, False), (0.031, True)])
def test_surface_that_is_looked_through_is_told_of_where_it_is_more_than_right_poses_leave(contradicted: float, is_told: bool) -> None:
    record = replace(judged(room()[1]), contradicted=np.full(FRAMES, contradicted, np.float32), is_doubtful=np.arange(FRAMES) < 9)
    assert ("look through 3%" in pose_doubt.findings(record)[0].text) == is_told


SIGHTED = np.zeros(FRAMES, dtype=bool)  # frames that are blind: none


@pytest.mark.parametrize(("n", "is_tied"), [(29, False), (30, True)])
def test_thirty_landmarks_seen_first_and_last_tie_two_key_frames(n: int, is_tied: bool) -> None:
    _, map_ = found(room()[1], ties=((3, 9), (20, 20)))
    rows = np.flatnonzero((map_.obs_lm < n) | (map_.obs_lm >= 50))
    map_ = replace(map_, obs_lm=np.unique(map_.obs_lm[rows], return_inverse=True)[1], obs_kf=map_.obs_kf[rows])
    assert pose_doubt._ties(map_, SIGHTED).tolist() == ([[3, 9]] * 2 if is_tied else [])


def seen_in(*key_frames: int) -> Map:
    """A map whose landmarks are each seen in all of these key frames."""
    _, map_ = found(room()[1], ties=((key_frames[0], key_frames[-1]),))
    n = int(map_.obs_lm.max()) + 1
    return replace(map_, obs_lm=np.repeat(np.arange(n), len(key_frames)), obs_kf=np.tile(key_frames, n))


def test_landmarks_tie_each_key_frame_to_the_next_that_sees_them() -> None:
    assert sorted(pose_doubt._ties(seen_in(3, 6, 9), SIGHTED).tolist()) == [[3, 6], [3, 9], [6, 9]]


def test_landmarks_tie_key_frames_past_one_that_shows_no_static_world_and_not_to_it() -> None:
    is_blind = np.arange(FRAMES) == 9
    assert np.unique(pose_doubt._ties(seen_in(3, 6, 9, 12), is_blind), axis=0).tolist() == [[3, 6], [3, 12], [6, 12]]
    assert len(pose_doubt._ties(seen_in(3, 9), is_blind)) == 0
