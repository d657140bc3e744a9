"""Which pairs of key frames are tried for a loop: at the limits of likeness, distance, direction and covisibility."""

import numpy as np
import pytest
from plain_maps import plain_map, share, words_in

from slamcli.config.options import LoopConfig
from slamcli.geometry import se3
from slamcli.slam.loop_candidates import AHEAD, Candidate, Claims, find_alike, find_by_pose, first_of_each_revisit
from slamcli.slam.place_recognition import PlaceIndex

HERE = se3.exp(np.array([0.4, -3.0, 1.5, 0.3, -1.1, 0.2]))
TEN = list(range(10))


def common(n: int, kf: int) -> list[int]:
    """Ten words, of which `n` are those of TEN and the others are this key frame's own."""
    return TEN[:n] + [100 * kf + k for k in range(10 - n)]


def alike(words: list[list[int]], *, shared: tuple[tuple[int, int, int], ...] = (), **options) -> list[tuple[int, int]]:
    """Return the candidates among key frames of these words, of which (i, j) share n landmarks."""
    sparse_map = plain_map(np.tile(np.eye(4), (len(words), 1, 1)))
    for i, j, n in shared:
        share(sparse_map, (i, j), n)
    found = find_alike(sparse_map, PlaceIndex(words_in(words), sparse_map.kf.frame), LoopConfig(**options))
    assert all(not c.is_by_pose for c in found)
    return [(c.kf_i, c.kf_j) for c in found]


@pytest.mark.parametrize(("n", "is_found"), [(5, True), (4, False)])
def test_a_key_frame_without_neighbours_must_look_as_alike_as_the_least_score_says(n, is_found):
    assert alike([TEN, common(n, 1)], min_score=0.45) == ([(1, 0)] if is_found else [])


def test_the_least_score_itself_is_enough():
    words = [TEN, common(5, 1)]
    score = float(PlaceIndex(words_in(words), np.arange(2)).scores(1)[0])
    assert score == pytest.approx(0.5)
    assert alike(words, min_score=score) and not alike(words, min_score=float(np.nextafter(score, 1.0)))


def test_nothing_in_common_is_no_candidate_however_low_the_least_score():
    assert alike([TEN, common(0, 1)], min_score=0.0) == []


@pytest.mark.parametrize(("n", "is_found"), [(3, True), (2, False)])
def test_a_place_must_look_as_alike_as_its_share_of_what_the_neighbours_do(n, is_found):
    """Key frame 3 is 0.4 and 0.6 alike to its neighbours 1 and 2: half of that is 0.25."""
    words = [common(n, 5), [*TEN[:4], *range(500, 506)], [*TEN[:4], 600, 601, *range(500, 504)], [*TEN[:4], *range(600, 606)]]
    assert PlaceIndex(words_in(words), np.arange(4)).scores(3)[:3] == pytest.approx([0.1 * n, 0.4, 0.6])
    neighbours = ((1, 3, 15), (2, 3, 15))
    assert ((3, 0) in alike(words, shared=neighbours, min_score=0.9, score_share=0.5)) == is_found
    assert (3, 0) in alike(words, shared=neighbours, min_score=0.15, score_share=0.5), "the lower one of the two counts"


def test_neighbours_that_look_the_same_do_not_raise_the_least_score():
    words = [common(4, 5), TEN, TEN]
    assert (2, 0) in alike(words, shared=((1, 2, 15),), min_score=0.35, score_share=1.0)


@pytest.mark.parametrize(("n_shared", "is_found"), [(14, True), (15, False)])
def test_those_that_share_enough_landmarks_are_no_candidates(n_shared, is_found):
    assert bool(alike([TEN, TEN], shared=((0, 1, n_shared),), min_shared=15)) == is_found
    T = np.tile(np.eye(4), (2, 1, 1))
    sparse_map = plain_map(T)
    share(sparse_map, (0, 1), n_shared)
    places = PlaceIndex(words_in([TEN, TEN]), sparse_map.kf.frame)
    assert bool(find_by_pose(sparse_map, places, LoopConfig(min_shared=15))) == is_found


def test_the_most_alike_come_first_and_each_pair_once():
    words = [common(n, k) for k, n in enumerate((6, 9, 4, 7, 10))]
    found = alike(words, min_score=0.3, candidates=2)
    assert all(j < i for i, j in found) and len(set(found)) == len(found)
    assert found[0] == (4, 1) and {(4, 3), (3, 1), (3, 0)} <= set(found) and (4, 0) not in found and (4, 2) not in found


def near(T_wk: list[np.ndarray], *, segment: list[int] | None = None, reach: float = 0.7) -> list[tuple[int, int]]:
    sparse_map = plain_map(np.array(T_wk), segment=segment)
    found = find_by_pose(sparse_map, PlaceIndex(words_in([TEN] * len(T_wk)), sparse_map.kf.frame), LoopConfig(near=reach))
    assert all(c.is_by_pose and c.score == pytest.approx(1.0) for c in found)
    return [(c.kf_i, c.kf_j) for c in found]


def about_the_spot(degrees: float) -> np.ndarray:
    """Look at the same spot from another direction: turn about it."""
    T, ahead = np.eye(4), se3.exp(np.array([0, 0, AHEAD, 0, 0, 0]))
    T[:3, :3] = se3.exp(np.array([0, 0, 0, 0, np.radians(degrees), 0]))[:3, :3]
    return ahead @ T @ se3.inverse(ahead)


@pytest.mark.parametrize(
    ("T", "is_near"),
    [
        (se3.exp(np.array([0.68, 0, 0, 0, 0, 0])), True),
        (se3.exp(np.array([0.5, 0, 0.5, 0, 0, 0])), False),
        (se3.exp(np.array([0, 0, 0, 0, np.radians(19.0), 0])), True),  # the spot moves by 2 * 2 m * sin(9.5 degrees) = 0.66 m
        (se3.exp(np.array([0, 0, 0, 0, np.radians(21.0), 0])), False),
        (se3.exp(np.array([0, 0, 0, 0, 0, np.radians(180.0)])), True),  # about the line of sight
        (about_the_spot(44.0), True),
        (about_the_spot(47.0), False),  # MIN_COSINE is that of 45.6 degrees
    ],
)
def test_two_that_look_at_one_spot_are_candidates(T, is_near):
    assert near([HERE, HERE @ T]) == ([(1, 0)] if is_near else [])


def test_of_several_near_ones_the_nearest_is_tried_and_the_nearest_pairs_come_first():
    at = [HERE @ se3.exp(np.array([x, 0, 0, 0, 0, 0])) for x in (0.0, 5.0, 5.4, 0.3, 0.2)]
    assert near(at) == [(4, 3), (3, 0), (2, 1)]


def test_those_of_two_segments_are_no_candidates_by_pose():
    assert near([HERE] * 3, segment=[0, 1, 0]) == [(2, 0)]


@pytest.mark.parametrize(("i", "j", "is_same"), [(13, 27, True), (10, 33, True), (14, 30, False), (6, 30, False), (10, 34, False)])
def test_a_claim_covers_its_span_to_either_side(i, j, is_same):
    claims = Claims([Candidate(10, 30, 0.5)], span=3)
    assert claims.cover(Candidate(i, j, 0.5)) == is_same
    assert len(first_of_each_revisit([Candidate(10, 30, 0.5), Candidate(i, j, 0.5)], span=3)) == 2 - is_same


def test_scores_asked_for_again_are_the_same_until_a_key_frame_comes():
    places = PlaceIndex(words_in([TEN, common(5, 1), common(8, 2)]), np.arange(2))
    first = places.scores(1)
    first[:] = 0.0  # the caller's own
    assert places.scores(1).tolist() == pytest.approx([0.5, 1.0])
    places.add(2)
    assert places.scores(1).tolist() == pytest.approx([0.5, 1.0, 0.5])
