"""What becomes of loop candidates, verified by a test's own word: which are tried, which join segments, which are dropped, what is fused."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from plain_maps import plain_map, share, words_in
from scenes import CAMERA

from slamcli.config.options import LoopConfig, SensorConfig
from slamcli.console import silent
from slamcli.geometry import se3
from slamcli.slam import loop_closing
from slamcli.slam.loop_candidates import Candidate
from slamcli.slam.loop_closing import LoopCloser
from slamcli.slam.map_merging import Join
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.frame import FrameStore

N = 60
AWAY = se3.exp(np.array([2.0, 0, 0, 0, 0, 0]))
Pair = tuple[int, int]


def ring(n: int = N) -> np.ndarray:
    """Key frames on their way once round, the last beside the first."""
    step = se3.exp(np.array([0.1, 0, 0, 0, 2 * np.pi / n, 0]))
    T_wk = [np.eye(4)]
    for _ in range(n - 1):
        T_wk.append(T_wk[-1] @ step)
    return np.array(T_wk)


class Rounds:
    """A loop closer whose candidates are given, and verified unless they are `refused`; the poses of the `false` ones are wrong.

    tried : what was verified, in order; fused : key frames in which landmarks were looked for, and which
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        *,
        alike: list[Pair],
        near: list[Pair] = (),
        false: tuple[Pair, ...] = (),
        refused: tuple[Pair, ...] = (),
        segment: list[int] | None = None,
        n_inliers: dict[Pair, int] | None = None,
        matches_of_refused: int = 100,
        objection: Callable[[Join], str] = loop_closing.no_objection,
        is_stiff: bool = True,
        **settings,
    ) -> None:
        self.truth, self.tried, self.fused = ring(), [], []
        self.map = plain_map(self.truth, segment=segment)
        for k in range(1, N if is_stiff else 0):
            share(self.map, (k - 1, k), 100)

        def verify(sparse_map, words, c, *_) -> Candidate:
            self.tried.append((c.kf_i, c.kf_j))
            if self.tried[-1] in refused:
                return replace(c, n_matches=matches_of_refused).rejected("refused")
            T_ij = se3.inverse(self.truth[c.kf_i]) @ self.truth[c.kf_j] @ (AWAY if self.tried[-1] in false else np.eye(4))
            return Candidate(c.kf_i, c.kf_j, c.score, 100, (n_inliers or {}).get(self.tried[-1], 100), T_ij=T_ij, is_by_pose=c.is_by_pose)

        monkeypatch.setattr(loop_closing, "verify", verify)
        monkeypatch.setattr(loop_closing, "find_alike", lambda *_: [Candidate(i, j, 0.5) for i, j in alike])
        monkeypatch.setattr(loop_closing, "find_by_pose", lambda *_: [Candidate(i, j, 0.5, is_by_pose=True) for i, j in near])
        monkeypatch.setattr(loop_closing, "fuse_landmarks", lambda _, kf, ids, *__, **___: self.fused.append((kf, set(ids.tolist()))))
        monkeypatch.setattr(map_adjustment, "adjust", lambda *_, **__: None)
        self.closer = LoopCloser(
            self.map, words_in([[0]] * N), FrameStore(self.map.features, CAMERA, SensorConfig()), LoopConfig(**settings),
            np.random.default_rng(0), loop_closing.Objections(to_join=objection),
        )  # fmt: skip

    def fate(self) -> dict[Pair, str]:
        return {pair: c.reason for pair, c in self.closer.fate.items()}


def test_one_closure_stands_for_those_around_it(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(50, 2), (45, 7), (59, 9), (44, 2), (56, 2)], closure_spacing=5, rounds=1)
    rounds.closer.close_loops(silent)
    assert rounds.tried == [(50, 2), (59, 9), (44, 2), (56, 2)]


def test_a_candidate_that_was_refused_stands_for_none(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(50, 2), (51, 2), (52, 2)], refused=((50, 2),), closure_spacing=5, rounds=1)
    tried = rounds.closer.close_loops(silent)
    assert rounds.tried == [(50, 2), (51, 2)]
    assert [(c.kf_i, c.kf_j, c.is_accepted) for c in tried] == [(50, 2, False), (51, 2, True)]
    assert rounds.fate() == {(50, 2): "refused", (51, 2): ""}


def test_what_the_graph_contradicts_is_dropped_and_words_do_not_name_it_again(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(59, 0), (30, 5), (31, 5)], near=[(32, 5)], false=((30, 5), (31, 5)), closure_spacing=3, rounds=3)
    rounds.closer.close_loops(silent)
    assert rounds.tried == [(59, 0), (30, 5), (32, 5)], "in the second round the poses of now name (32, 5), the words (31, 5)"
    fate = rounds.fate()
    assert fate[59, 0] == "" and "contradicts it (chi2 " in fate[30, 5] and fate[32, 5] == ""
    assert np.abs(rounds.map.kf.T_wk - rounds.truth).max() < 0.02


@pytest.mark.parametrize(("n_matches", "times"), [(19, 1), (20, 2)])
def test_what_had_too_few_matches_is_not_asked_again_and_what_the_map_may_have_changed_is(monkeypatch, n_matches: int, times: int):
    alike, false = [(59, 0), (30, 5), (45, 20)], ((45, 20),)  # what the graph contradicts asks for a second round
    rounds = Rounds(monkeypatch, alike=alike, false=false, refused=((30, 5),), matches_of_refused=n_matches, min_matches=20, rounds=3)
    rounds.closer.close_loops(silent)
    assert rounds.tried.count((30, 5)) == times and rounds.fate()[30, 5] == "refused"


@pytest.mark.parametrize(("is_refined", "shift", "n_rounds", "n_adjusted"), [(True, 0.0, 1, 0), (False, 0.0, 1, 1), (True, 0.02, 2, 1)])
def test_rounds_end_where_closures_move_nothing(monkeypatch, is_refined: bool, shift: float, n_rounds: int, n_adjusted: int):
    rounds, adjusted = Rounds(monkeypatch, alike=[(59, 0), (30, 5)], refused=((30, 5),), rounds=3, final_refinement=is_refined), []
    monkeypatch.setattr(map_adjustment, "adjust", lambda *_, **how: adjusted.append(how))
    rounds.truth[59, 0, 3] += shift  # where the closure says that it is
    rounds.closer.close_loops(silent)
    assert rounds.tried.count((30, 5)) == n_rounds and len(adjusted) == n_adjusted
    assert {kf for kf, _ in rounds.fused} >= {59, 0}


def test_where_the_graph_contradicts_all_the_map_stays_and_no_further_round_is_made(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(30, 5)], false=((30, 5),), rounds=3)
    before = rounds.map.kf.T_wk.copy()
    rounds.closer.close_loops(silent)
    np.testing.assert_array_equal(rounds.map.kf.T_wk, before)
    assert rounds.tried == [(30, 5)] and rounds.fused == []


def test_after_a_round_that_closed_nothing_no_other_is_made(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(50, 2)], refused=((50, 2),), rounds=3)
    assert [c.reason for c in rounds.closer.close_loops(silent)] == ["refused"] and rounds.tried == [(50, 2)]


HALVES = [0] * 30 + [1] * 30
THIRDS = [0] * 20 + [1] * 20 + [2] * 20


def test_within_one_segment_nothing_is_there_to_join(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(50, 2), (40, 9)])
    rounds.closer.join_segments()
    assert rounds.tried == [] and rounds.fate() == {}


def test_segments_are_joined_by_closures_between_them_alone(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(50, 2), (20, 2), (40, 12), (39, 12)], segment=HALVES, is_stiff=False, closure_spacing=10)
    rounds.closer.join_segments()
    assert rounds.tried == [(50, 2), (40, 12), (39, 12)] and rounds.fate() == dict.fromkeys(rounds.tried, "")
    assert (rounds.map.kf.segment == 0).all() and {kf for kf, _ in rounds.fused} == {50, 2, 39, 12}, "(40, 12) is covered by (50, 2)"


@pytest.mark.parametrize(("refused", "n_left"), [(((40, 9),), 1), (((40, 9), (50, 2)), 0)])
def test_too_few_closures_join_nothing_and_it_is_told(monkeypatch, refused: tuple, n_left: int):
    rounds = Rounds(monkeypatch, alike=[(50, 2), (40, 9)], refused=refused, segment=HALVES, join_closures=2)
    rounds.closer.join_segments()
    assert rounds.map.kf.segment.tolist() == HALVES
    assert sum(reason == "refused" for reason in rounds.fate().values()) == len(refused)
    assert sum("fewer than 2" in reason for reason in rounds.fate().values()) == n_left


def test_what_says_otherwise_than_a_join_is_tried_again_as_a_loop(monkeypatch):
    pairs = [(50, 2), (40, 9), (35, 15)]
    rounds = Rounds(monkeypatch, alike=pairs, false=((35, 15),), n_inliers={(35, 15): 60}, segment=HALVES, closure_spacing=0, rounds=1)
    rounds.closer.join_segments()
    assert rounds.fate() == {(50, 2): "", (40, 9): ""}
    rounds.closer.close_loops(silent)
    assert rounds.tried[3:] == [(35, 15)] and "contradicts" in rounds.fate()[35, 15]


def test_an_objection_keeps_two_segments_apart_and_the_next_best_join_is_made(monkeypatch):
    asked = []

    def objection(found: Join) -> str:
        asked.append((found.a, found.b))
        return "not the same house" if found.b == 1 else ""

    pairs = [(30, 2), (25, 9), (45, 3), (50, 8)]
    inliers = {(30, 2): 200, (25, 9): 200}
    rounds = Rounds(monkeypatch, alike=pairs, n_inliers=inliers, segment=THIRDS, objection=objection)
    rounds.closer.join_segments()
    assert asked == [(0, 1), (0, 2)]
    assert rounds.map.kf.segment.tolist() == [0] * 20 + [1] * 20 + [0] * 20
    assert rounds.fate() == {(30, 2): "not the same house", (25, 9): "not the same house", (45, 3): "", (50, 8): ""}


def test_three_segments_become_one_through_the_second(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(30, 2), (25, 9), (45, 33), (50, 38)], segment=THIRDS)
    rounds.map.kf.T_wk[20:40] = AWAY @ rounds.truth[20:40]
    rounds.map.kf.T_wk[40:] = se3.inverse(AWAY) @ rounds.truth[40:]
    rounds.closer.join_segments()
    assert (rounds.map.kf.segment == 0).all()
    np.testing.assert_allclose(rounds.map.kf.T_wk, rounds.truth, atol=1e-9)


@pytest.mark.parametrize(("most", "here"), [(0, {50}), (1, {50, 48}), (10, {50, 48, 49})])
def test_each_side_of_a_closure_is_looked_for_on_the_other(monkeypatch, most: int, here: set[int]):
    rounds = Rounds(monkeypatch, alike=[], neighbours=most, edge_shared=30, is_stiff=False)
    ids = {pair: set(share(rounds.map, pair, n).tolist()) for pair, n in {(48, 50): 40, (49, 50): 30, (51, 50): 29, (2, 3): 29}.items()}
    rounds.closer._fuse_around(Candidate(50, 2, 0.5))
    of_50 = set().union(*(ids[pair] for pair in ids if 50 in pair))
    assert {kf for kf, _ in rounds.fused} == here | {2}
    assert all(seen == ids[2, 3] for kf, seen in rounds.fused if kf != 2) and dict(rounds.fused)[2] == of_50


def test_what_was_refused_is_tried_again_on_the_corrected_map(monkeypatch):
    rounds = Rounds(monkeypatch, alike=[(50, 2), (30, 20)], refused=((50, 2),), rounds=2)
    rounds.truth[30, 0, 3] += 0.02  # where the closure says that it is
    rounds.closer.close_loops(silent)
    assert rounds.tried == [(50, 2), (30, 20), (50, 2)]


@pytest.mark.parametrize(("is_refined", "tolerance"), [(True, map_adjustment.NEARLY), (False, map_adjustment.CONVERGED)])
def test_the_map_comes_to_its_optimum_once(monkeypatch, is_refined, tolerance):
    rounds, given = Rounds(monkeypatch, alike=[(59, 0)], final_refinement=is_refined), []
    monkeypatch.setattr(map_adjustment, "adjust", lambda *_, **how: given.append(how["tolerance"]))
    rounds.truth[59, 0, 3] += 0.02  # where the closure says that it is
    rounds.closer.close_loops(silent)
    assert given == [tolerance]


@pytest.mark.parametrize("axis", range(6))
def test_one_key_frame_that_moves_more_than_a_little_along_or_about_any_axis_has_moved(axis: int) -> None:
    before = np.tile(np.eye(4), (5, 1, 1))
    least = loop_closing.SETTLED_M if axis < 3 else loop_closing.SETTLED_RAD
    for part, expected in ((0.98, False), (1.02, True), (-1.02, True)):
        twist = np.zeros((5, 6))
        twist[3, axis] = part * least
        assert loop_closing.has_moved(before, before @ se3.exp(twist)) == expected


def test_little_motions_do_not_add_up() -> None:
    """Neither those of many key frames, nor a shift and a turn of one."""
    before = np.tile(np.eye(4), (100, 1, 1))
    shift, turn = loop_closing.SETTLED_M, loop_closing.SETTLED_RAD
    assert not loop_closing.has_moved(before, before @ se3.exp(np.tile([0.95 * shift, 0, 0, 0.95 * turn, 0, 0], (100, 1))))
