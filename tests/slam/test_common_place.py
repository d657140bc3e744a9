"""Whether two parts of a map can be one place: corridors that differ at their ends alone, and closures between doors that look alike."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamcli import api
from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate
from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry import se3
from slamcli.runs.run_directory import RunDir
from slamcli.schema import CoarseDepth, Features, Map, Recordings
from slamcli.slam import common_place, loop_pose_graph
from slamcli.slam.common_place import LEAST_EXPECTED, count_otherwise
from slamcli.slam.loop_candidates import Candidate
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap

CORRIDOR = {"alias": "corridor", "seed": 102, "width": 160, "height": 120, "frames": 120, "laps": 1.05}


def places(*shares: tuple[int, float]) -> tuple[int, int]:
    """Count places, and those that look different, of so many landmarks that should be seen each, and the shares that were."""
    place = np.repeat(np.column_stack([np.arange(len(shares)), np.zeros((len(shares), 2), int)]), [n for n, _ in shares], axis=0)
    is_found = np.concatenate([np.arange(n) < round(share * n) for n, share in shares])
    order = np.random.default_rng(0).permutation(len(place))
    return count_otherwise(place[order], is_found[order])


def test_a_place_looks_different_where_far_fewer_landmarks_are_found_than_elsewhere() -> None:
    everywhere = (2000, 0.5)
    assert places(everywhere, (200, 0.0), (200, 0.05), (200, 0.2)) == (4, 2)
    assert places((2000, 0.25), (200, 0.1)) == (2, 0), "where all is hard to find again, little says less"
    assert places(everywhere, (LEAST_EXPECTED - 1, 0.0)) == (1, 0)
    assert places(everywhere, (LEAST_EXPECTED, 0.0)) == (2, 1)
    assert count_otherwise(np.zeros((0, 3), int), np.zeros(0, bool)) == (0, 0)


@pytest.mark.parametrize(("n_places", "most"), [(13, 1), (39, 1), (40, 2), (171, 8)])
def test_one_place_that_looks_different_and_a_few_of_many_are_no_objection_and_more_are(n_places: int, most: int) -> None:
    evidence = [common_place.Comparison(agreement=0.99, n_pairs=20, n_places=n_places, n_otherwise=n) for n in (0, 1, most, most + 1)]
    assert [bool(one.objection) for one in evidence] == [False, False, False, True]


def different(monkeypatch: pytest.MonkeyPatch, is_alike: list[bool]) -> tuple[common_place.Comparison, int]:
    """Compare two parts whose pairs of near views are alike as told; returns also how many pairs were looked at."""
    asked = []

    def are_alike(_jury, _poses, i: int, j: int) -> bool:
        asked.append((i, j))
        return is_alike[i]

    monkeypatch.setattr(common_place.Jury, "_are_alike", are_alike)
    jury, pairs = common_place.Jury.__new__(common_place.Jury), [(k, k) for k in range(len(is_alike))]
    found = common_place.Comparison(len(pairs), jury._count_different(np.zeros((0, 4, 4)), pairs))
    assert asked == pairs[: len(asked)]
    return found, len(asked)


@pytest.mark.parametrize("seed", range(20))
def test_pairs_are_looked_at_until_they_say_what_all_of_them_would(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    rng = np.random.default_rng(seed)
    is_alike = (rng.random(rng.integers(0, 30)) < rng.uniform(0.3, 0.7)).tolist()
    found, _ = different(monkeypatch, is_alike)
    assert bool(found.objection) == (is_alike.count(False) > common_place.MOST_DIFFERENT * len(is_alike))


@pytest.mark.parametrize(("is_alike", "looked_at"), [([False] * 10, 6), ([True] * 10, 5), ([True, False] * 5, 9), ([], 0)])
def test_no_pair_is_looked_at_once_it_is_decided(monkeypatch: pytest.MonkeyPatch, is_alike: list[bool], looked_at: int) -> None:
    assert different(monkeypatch, is_alike)[1] == looked_at


@pytest.fixture(scope="module")
def corridors(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDir, RunDir]:
    """A corridor and another that differs from it at its ends alone; the corridor and itself on another day."""
    folder = tmp_path_factory.mktemp("corridors")
    ways = {"here": {}, "elsewhere": {"twin": 1, "take": 1}, "again": {"take": 1, "start": 0.35, "light": 0.75}}
    for name, how in ways.items():
        simulate(folder / name, progress=silent, **CORRIDOR, **how)
    both = ([folder / "here", folder / other] for other in ("elsewhere", "again"))
    other, same = (api.run(pair, path=folder / f"run_{k}", until="loop").directory for k, pair in enumerate(both))
    return other, same


def is_joined(run: RunDir) -> bool:
    first, map_ = int(run.load(Recordings, "extract").recording_offset[1]), run.load(Map, "loop")
    is_first = map_.kf_frame < first
    return bool(set(map_.kf_segment[is_first]) & set(map_.kf_segment[~is_first]))


def test_corridors_that_differ_at_their_ends_alone_are_kept_apart_and_one_seen_twice_is_joined(corridors: tuple[RunDir, RunDir]) -> None:
    other, same = corridors
    assert not is_joined(other) and is_joined(same)
    reasons = Path(other.path / "loop" / "candidates.csv").read_text()
    assert "look different from the two sides" in reasons


def jury_of(run: RunDir, moved: np.ndarray) -> tuple[common_place.Jury, SparseMap, np.ndarray]:
    """A jury over a recording's map whose later half odometry took astray by `moved` (4, 4), and where its key frames truly stand."""
    features, map_ = run.load(Features, "extract"), run.load(Map, "loop")
    sparse_map = SparseMap.from_map(features, map_)
    T_wk = np.array(map_.T_wk)
    astray = T_wk.copy()
    astray[len(T_wk) // 2 :] = moved @ T_wk[len(T_wk) // 2 :]
    loop_pose_graph.move(sparse_map, astray)
    frames = FrameStore(features, run.camera("loop"), run.config().sensor)
    return common_place.Jury(sparse_map, CoarseImages(run.load(CoarseDepth, "extract")), frames, run.config().loop), sparse_map, T_wk


@pytest.mark.parametrize(
    ("off", "is_refused"),
    [([0.0] * 6, False), ([0.05, 0, 0.02, 0, 0.01, 0], False), ([0, 0, 0.8, 0, 0, 0], True), ([0, 0, 0, 0, 0.4, 0], True)],
)
def test_a_closure_that_moves_its_view_far_is_refused_where_the_views_around_differ(corridors, off, is_refused) -> None:
    run = RunDir(corridors[0].recording_path("here"))
    api.open_run(run.path).update(until="loop")
    jury, sparse_map, T_wk = jury_of(run, se3.exp(np.array([1.0, 0.0, 0.5, 0.0, 0.1, 0.0])))
    i, j = len(T_wk) - 1, int(np.argmin(np.linalg.norm(T_wk[: len(T_wk) // 3, :3, 3] - T_wk[-1, :3, 3], axis=1)))
    T_ij = se3.inverse(T_wk[i] @ se3.exp(np.array(off, float))) @ T_wk[j]
    closure = Candidate(i, j, 0.4, n_inliers=90, T_ij=T_ij)
    assert bool(jury.objection_to_closure(closure)) == is_refused
    T_now = se3.inverse(sparse_map.kf.T_wk[i]) @ sparse_map.kf.T_wk[j]
    assert jury.objection_to_closure(replace(closure, T_ij=T_now)) == "", "it says what odometry says"
