"""What the options of optimize and loop do, in the direction that their help promises: on a turn and a bit inside a round room."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_run import Run
from scenes import CAMERA, Scene, ape, observe, orbit, room_points

from slamcli.config.options import LoopConfig, OptimizeConfig, SensorConfig
from slamcli.geometry import se3
from slamcli.schema import KEY_FRAME, Map, Moving, Rests, Timing, Tracks
from slamcli.slam import final_refinement, loop_candidates, loop_pose_graph, loop_verification
from slamcli.slam.loop_candidates import Candidate
from slamcli.slam.loop_closing import LoopCloser
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import loop, optimize

SENSOR = SensorConfig(pixel_noise=0.5)
N, LAP = 44, 40  # key frames, and those of one turn: the last four see what the first four saw
FORGOTTEN = 10  # key frames after which a landmark that is seen again is taken for a new one


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(0)
    return observe(orbit(N, turns=N / LAP), room_points(5000, rng), rng, per_frame=300)


def mapped(scene: Scene, *, drift: float = 0.0) -> SparseMap:
    """Every frame a key frame; landmarks of the first lap are not known again in the second, and the path drifts [m a key frame]."""
    sparse_map, known = SparseMap(scene.features), {}
    for frame, T_gc in enumerate(scene.T_gc):
        kf = sparse_map.add_key_frame(frame, T_gc)
        rows = np.arange(*scene.features.offset[frame : frame + 2])
        of = scene.landmark[rows].tolist()
        is_known = np.array([landmark in known and frame - known[landmark][1] < FORGOTTEN for landmark in of])
        ids = np.zeros(len(rows), np.int32)
        ids[is_known] = [known[landmark][0] for landmark in np.array(of)[is_known].tolist()]
        sparse_map.observe(kf, ids[is_known], rows[is_known])
        ids[~is_known] = sparse_map.add_landmarks(kf, rows[~is_known], scene.xyz[np.array(of)[~is_known]])
        known |= {landmark: (int(i), frame) for landmark, i in zip(of, ids, strict=True)}
    T_wk = sparse_map.kf.T_wk.copy()
    for k in range(1, N):
        T_wk[k] = (
            T_wk[k - 1] @ se3.inverse(scene.T_gc[k - 1]) @ scene.T_gc[k] @ se3.exp(np.array([drift, 0.3 * drift, 0, 0, 0.1 * drift, 0]))
        )
    loop_pose_graph.move(sparse_map, T_wk)
    return sparse_map


def candidates(scene: Scene, **options) -> list[Candidate]:
    sparse_map = mapped(scene)
    return loop_candidates.find_alike(sparse_map, PlaceIndex(scene.words, sparse_map.kf.frame), LoopConfig(**options))


def near(scene: Scene, **options) -> list[Candidate]:
    sparse_map = mapped(scene, drift=0.002)
    return loop_candidates.find_by_pose(sparse_map, PlaceIndex(scene.words, sparse_map.kf.frame), LoopConfig(**options))


def verified(scene: Scene, candidate: Candidate = Candidate(41, 1, 0.5), *, seed: int = 1, drift: float = 0.0, **options) -> Candidate:  # noqa: B008
    rng = np.random.default_rng(seed)
    return loop_verification.verify(mapped(scene, drift=drift), scene.words, candidate, scene.frames(SENSOR), LoopConfig(**options), rng)


# loop: candidates


@pytest.mark.shows("loop.candidates")
def test_so_many_key_frames_are_looked_at_per_key_frame(scene: Scene) -> None:
    for most in (1, 3):
        of = [c.kf_i for c in candidates(scene, candidates=most, min_score=0.01)]
        assert np.bincount(of).max() == most


@pytest.mark.shows("loop.min_score", "loop.score_share")
def test_a_lower_score_makes_more_candidates(scene: Scene) -> None:
    strict, low_score, low_share = (
        len(candidates(scene, **{"min_score": 1.0, "score_share": 1.0} | option))
        for option in ({}, {"min_score": 0.01}, {"score_share": 0.02})
    )
    assert strict < low_score and strict < low_share


@pytest.mark.shows("loop.near")
def test_key_frames_that_look_at_spots_this_near_are_candidates(scene: Scene) -> None:
    none, few, many = (len(near(scene, near=reach)) for reach in (0.0, 0.3, 2.5))
    assert none == 0 < few < many


@pytest.mark.shows("loop.min_shared")
def test_key_frames_that_share_enough_landmarks_are_joined_already(scene: Scene) -> None:
    few_join, many_join = (len(candidates(scene, min_shared=n)) for n in (10**6, 15))
    assert many_join < few_join


# loop: verification


@pytest.mark.shows("loop.min_matches", "loop.min_inliers")
def test_a_candidate_with_less_evidence_than_asked_for_is_rejected(scene: Scene) -> None:
    assert verified(scene).is_accepted
    assert "of 1000 matches" in verified(scene, min_matches=1000).reason
    assert "of 1000 landmarks" in verified(scene, min_inliers=1000).reason


def n_verified(scene: Scene, **options) -> int:
    """Of eight tries to verify a true candidate, most of whose matches are wrong, count those that succeed."""
    rows, rng = np.arange(*scene.features.offset[41:43]), np.random.default_rng(0)
    mixed = rng.permutation(rows[90:])
    desc, word = scene.features.desc.copy(), scene.words.word.copy()
    desc[rows[90:]], word[rows[90:]] = desc[mixed], word[mixed]
    spoilt = replace(scene, features=replace(scene.features, desc=desc), words=replace(scene.words, word=word))
    return sum(verified(spoilt, seed=seed, min_inliers=30, **options).is_accepted for seed in range(8))


@pytest.mark.shows("loop.ransac_rounds")
def test_more_samples_verify_more_candidates(scene: Scene) -> None:
    assert n_verified(scene, ransac_rounds=1) < 7 <= n_verified(scene, ransac_rounds=300)


@pytest.mark.shows("loop.ransac_threshold_px")
def test_a_threshold_below_the_noise_verifies_hardly_any_candidate(scene: Scene) -> None:
    assert n_verified(scene, ransac_threshold_px=1e-3) < 7 <= n_verified(scene, ransac_threshold_px=6.0)


@pytest.mark.shows("loop.search_radius_px")
def test_landmarks_around_a_candidate_are_looked_for_in_a_window(scene: Scene) -> None:
    """The poses of now are some pixels off."""
    here = Candidate(41, 1, 0.5, is_by_pose=True)
    narrow, wide = (verified(scene, here, drift=0.001, search_radius_px=radius, min_inliers=6).n_inliers for radius in (0.1, 8.0))
    assert narrow < 0.5 * wide


@pytest.mark.shows("loop.neighbours")
def test_landmarks_of_so_many_neighbours_take_part(scene: Scene) -> None:
    alone, together = (verified(scene, neighbours=n).n_inliers for n in (0, 10))
    assert alone < 0.9 * together


def closer(scene: Scene, sparse_map: SparseMap, **options) -> LoopCloser:
    return LoopCloser(sparse_map, scene.words, scene.frames(SENSOR), LoopConfig(**options), np.random.default_rng(0))


@pytest.mark.shows("loop.fuse_max_distance")
def test_landmarks_whose_descriptors_differ_more_are_not_fused(scene: Scene) -> None:
    n = []
    for most in (1, 50):
        sparse_map = mapped(scene)
        before = np.count_nonzero(sparse_map.lm.is_alive)
        closer(scene, sparse_map, fuse_max_distance=most)._fuse_around(Candidate(41, 1, 0.5))
        n.append(before - np.count_nonzero(sparse_map.lm.is_alive))
    assert n[0] < 0.1 * n[1]


# loop: the graph, and passes over it


@pytest.mark.shows("loop.edge_shared", "loop.edges_per_key_frame")
def test_the_pose_graph_has_the_edges_asked_for(scene: Scene) -> None:
    usual, chain, few = (
        len(loop_pose_graph.covisibility_edges(mapped(scene), LoopConfig(**options))[0])
        for options in ({}, {"edge_shared": 10**6}, {"edges_per_key_frame": 2})
    )
    assert chain == N - 1 < few <= 2 * N < usual


def closed(scene: Scene, *, drift: float = 0.002, **options) -> tuple[list[Candidate], SparseMap, int]:
    """Close the loop; returns all candidates, the map, and how many passes over it were made."""
    sparse_map, passes = mapped(scene, drift=drift), []
    tried = closer(scene, sparse_map, **options).close_loops(lambda items, label: passes.append(label) or items)
    return tried, sparse_map, len(passes)


@pytest.mark.shows("loop.rounds")
def test_so_many_passes_are_made_at_most(scene: Scene) -> None:
    assert closed(scene, rounds=1)[2] == 1 < closed(scene, rounds=3)[2] <= 3


@pytest.mark.shows("loop.closure_spacing")
def test_closures_stand_so_far_apart(scene: Scene) -> None:
    dense, sparse = (sum(c.is_accepted for c in closed(scene, closure_spacing=n, rounds=1)[0]) for n in (0, 100))
    assert sparse == 1 < dense


@pytest.mark.shows("loop.iterations")
def test_more_iterations_leave_a_map_that_fits_better(scene: Scene) -> None:
    cost = []
    for n in (1, 20):
        sparse_map = mapped(scene)
        sparse_map.kf.T_wk[1:] = sparse_map.kf.T_wk[1:] @ se3.exp(np.random.default_rng(0).normal(0, 0.02, (N - 1, 6)))
        closer(scene, sparse_map, iterations=n)._fuse_and_adjust([])
        left = map_adjustment.adjust(sparse_map, np.arange(N, dtype=np.int32), CAMERA, SENSOR, max_iterations=1)
        cost.append(left.cost[0])
    assert 0.0 < cost[1] < 0.95 * cost[0]


@pytest.mark.shows("loop.join_closures")
@pytest.mark.parametrize(("least", "n_segments"), [(2, 1), (1000, 2)])
def test_so_many_closures_join_two_segments(scene: Scene, least: int, n_segments: int) -> None:
    sparse_map = mapped(scene)
    sparse_map.kf.segment[20:] = 1
    closer(scene, sparse_map, join_closures=least).join_segments()
    assert len(np.unique(sparse_map.kf.segment)) == n_segments


# the stages


class Lap(Run):
    """A run that was tracked: every frame a key frame of a map that drifted."""

    def __init__(self, scene: Scene, folder: Path, *, drift: float = 0.002, noise: float = 0.0, segment: int = N, **settings) -> None:
        super().__init__(scene, folder, **settings)
        sparse_map = mapped(scene, drift=drift)
        sparse_map.kf.T_wk[1:] = sparse_map.kf.T_wk[1:] @ se3.exp(np.random.default_rng(0).normal(0, noise, (N - 1, 6)))
        sparse_map.kf.segment[segment:] = 1
        kf, n_inliers = np.arange(N, dtype=np.int32), np.full(N, 200, np.int32)
        self._records = {
            Map: sparse_map.snapshot(),
            Tracks: Tracks(kf, np.tile(np.eye(4), (N, 1, 1)), np.full(N, KEY_FRAME, np.uint8), n_inliers),
            Timing: Timing(np.array(0.0), np.array(0.0), np.array(0.0), np.zeros((N, 6))),
            Moving: Moving(),
            Rests: Rests(),
        }

    def load(self, cls, stage):
        return self._records[cls] if cls in self._records else super().load(cls, stage)

    def camera(self, stage="extract"):
        return CAMERA


@pytest.fixture
def refined(monkeypatch: pytest.MonkeyPatch) -> list[final_refinement.Refinement]:
    """Note what the second look at everything is asked for, instead of taking it."""
    asked: list[final_refinement.Refinement] = []

    def refine_all(sparse_map, tracked, by, **_):
        asked.append(by)
        return tracked.tracks, None

    monkeypatch.setattr(final_refinement, "refine_all", refine_all)
    return asked


@pytest.mark.shows("loop.enabled", "loop.final_refinement", "loop.depth_icp_edges", "loop.depth_icp_weight")
def test_loops_are_closed_and_looked_at_again_as_asked(scene: Scene, tmp_path: Path, refined: list[final_refinement.Refinement]) -> None:
    for name, options, is_closed, n_looks in (
        ("off", {"enabled": False}, False, 0),
        ("once", {"final_refinement": False}, True, 0),
        ("twice", {"depth_icp_edges": 4, "depth_icp_weight": 7.0}, True, 1),
    ):
        refined.clear()
        (tmp_path / name).mkdir()
        run = Lap(scene, tmp_path / name, **options)
        run.stage(loop)
        assert (run.summary["loop"]["closures"] > 0) == is_closed and len(refined) == n_looks
    assert refined[0].depth.most == 4 and refined[0].depth.weight == 7.0


@pytest.mark.shows("loop.main_segment")
def test_the_maps_are_made_of_the_segment_asked_for(scene: Scene, tmp_path: Path) -> None:
    for main, n in ((0, 30), (1, 14)):
        (tmp_path / str(main)).mkdir()
        run = Lap(scene, tmp_path / str(main), segment=30, enabled=False, main_segment=main)
        run.stage(loop)
        assert len((tmp_path / str(main) / "loop" / "trajectory.txt").read_text().splitlines()) - n in (0, 1)  # a line of comment


PLAIN = {"readout": False, "depth_delay": False, "move_depth": False}  # nothing of the camera is looked for


def optimized(scene: Scene, folder: Path, **options) -> tuple[dict, bool]:
    """Run optimize on a disturbed map; returns its summary, and whether it moved a key frame."""
    folder.mkdir()
    run = Lap(scene, folder, drift=0.0, noise=0.02, optimize=OptimizeConfig(**options))
    run.stage(optimize)
    before = run._records.pop(Map).T_wk
    return run.summary["optimize"], bool((run.load(Map, "optimize").T_wk != before).any())


@pytest.mark.shows("optimize.enabled", "optimize.iterations")
def test_the_map_is_adjusted_as_long_as_asked(scene: Scene, tmp_path: Path) -> None:
    (off, is_moved), (short, _), (long, _) = (
        optimized(scene, tmp_path / name, **options, **PLAIN)
        for name, options in (("off", {"enabled": False}), ("short", {"iterations": 1}), ("long", {"iterations": 30}))
    )
    assert "cost" not in off and not is_moved and 0.0 < long["cost"][-1] < 0.9 * short["cost"][-1]


@pytest.mark.shows("optimize.rounds")
def test_the_map_and_the_camera_are_found_in_so_many_turns(scene: Scene, tmp_path: Path) -> None:
    for n in (1, 3):
        summary, _ = optimized(scene, tmp_path / str(n), rounds=n, intrinsics=True, iterations=3, **PLAIN)
        assert len(summary["cost"]) == n + 1  # and one more with what was found


def test_the_scene_closes(scene: Scene) -> None:
    """What the tests above rest on."""
    tried, sparse_map, _ = closed(scene)
    assert any(c.is_accepted for c in tried) and ape(sparse_map.kf.T_wk, scene.T_gc) < 0.5 * ape(
        mapped(scene, drift=0.002).kf.T_wk, scene.T_gc
    )
