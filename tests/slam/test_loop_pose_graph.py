"""The pose graph of the key frames: which edges it has, what they weigh, what it holds still, and what moves along."""

import numpy as np
import pytest
from plain_maps import plain_map, share

from slamcli.config.options import LoopConfig
from slamcli.geometry import se3
from slamcli.slam import loop_pose_graph
from slamcli.slam.loop_candidates import Candidate
from slamcli.sparse_map.sparse_map import SparseMap

SETTINGS = LoopConfig(edge_shared=30, edges_per_key_frame=3)


def path(n: int) -> np.ndarray:
    """Key frames 0.1 m apart that turn by 0.1 rad each."""
    T_wk = [se3.exp(np.array([0.3, 0.2, -0.4, 0.5, -0.3, 0.1]))]
    for _ in range(n - 1):
        T_wk.append(T_wk[-1] @ se3.exp(np.array([0.1, 0, 0, 0, 0.1, 0])))
    return np.array(T_wk)


def edges(sparse_map: SparseMap) -> dict[tuple[int, int], float]:
    kfs, weight = loop_pose_graph.covisibility_edges(sparse_map, SETTINGS)
    assert len(np.unique(kfs, axis=0)) == len(kfs)
    return dict(zip(map(tuple, kfs.tolist()), weight.tolist(), strict=True))


@pytest.mark.parametrize(("n", "is_edge"), [(29, False), (30, True)])
def test_so_many_shared_landmarks_make_an_edge_that_weighs_as_many(n, is_edge):
    sparse_map = plain_map(path(3))
    share(sparse_map, (0, 2), n)
    assert edges(sparse_map) == {(1, 0): 1.0, (2, 1): 1.0} | ({(2, 0): 30.0} if is_edge else {})


def test_the_strongest_edges_are_kept_and_the_neighbour_in_time_whatever_it_shares():
    sparse_map = plain_map(path(6))
    for other, n in enumerate((40, 60, 35, 50, 2)):
        share(sparse_map, (other, 5), n)
    assert {e: w for e, w in edges(sparse_map).items() if e[0] == 5} == {(5, 1): 60.0, (5, 3): 50.0, (5, 0): 40.0, (5, 4): 2.0}


def test_neighbours_in_time_are_those_of_one_segment():
    assert set(edges(plain_map(path(5), segment=[0, 1, 0, 1, 2]))) == {(2, 0), (3, 1)}


@pytest.mark.parametrize(("n_shared", "weight"), [(0, 100.0), (99, 100.0), (130, 130.0)])
def test_depth_images_that_were_aligned_make_an_edge_worth_a_hundred_landmarks(n_shared, weight):
    sparse_map = plain_map(path(4))
    share(sparse_map, (0, 3), n_shared)
    sparse_map.add_edge(3, 0, np.eye(4), np.eye(6))
    assert edges(sparse_map) == {(1, 0): 1.0, (2, 1): 1.0, (3, 0): weight, (3, 2): 1.0}


@pytest.mark.parametrize(("n_inliers", "times"), [(50, 0.5), (100, 1.0), (300, 3.0), (900, 3.0)])
def test_an_edge_holds_what_the_map_says_and_is_as_certain_as_its_landmarks_are_many(n_inliers, times):
    T_wk = path(3)
    sparse_map = plain_map(T_wk)
    share(sparse_map, (0, 1), 200)
    closure = Candidate(2, 0, 0.5, 100, n_inliers, T_ij=se3.exp(np.array([0.1, 0, 0, 0, 0, 0.2])))
    graph = loop_pose_graph.build(sparse_map, [closure], SETTINGS)
    assert graph.edges.kf.tolist() == [[1, 0], [2, 1], [2, 0]] and graph.is_closure.tolist() == [False, False, True]
    x_w = np.array([0.2, -0.5, 3.0])
    for (i, j), T_ij in zip(graph.edges.kf[:2], graph.edges.T_ij[:2], strict=True):
        x_i, x_j = (se3.transform(se3.inverse(T_wk[kf]), x_w) for kf in (i, j))
        np.testing.assert_allclose(se3.transform(T_ij, x_j), x_i, atol=1e-12)
    np.testing.assert_array_equal(graph.edges.T_ij[2], closure.T_ij)
    of_hundred = np.diag([2500.0] * 3 + [10_000.0] * 3)  # 2 cm and 0.01 rad
    np.testing.assert_allclose(graph.edges.information, of_hundred * np.array([2.0, 0.01, times])[:, None, None])


def test_the_first_key_frame_of_each_segment_stays_where_it_is():
    sparse_map = plain_map(path(8), segment=[0, 0, 0, 1, 1, 1, 0, 1])
    before = sparse_map.kf.T_wk.copy()
    closures = [
        Candidate(i, j, 0.5, 100, 200, T_ij=se3.exp(np.array([0.01, 0, 0.02, 0, 0.005, 0])) @ se3.inverse(before[i]) @ before[j])
        for i, j in ((6, 0), (7, 3))
    ]
    graph = loop_pose_graph.solve(sparse_map, closures, SETTINGS)
    assert graph.is_kept.all()
    step = np.linalg.norm(se3.log(graph.T_wk @ se3.inverse(before)), axis=1)
    assert (step[[0, 3]] < 1e-12).all() and (step[[1, 2, 4, 5, 6, 7]] > 1e-4).all() and step.max() < 0.1


def test_a_landmark_moves_with_the_key_frame_that_created_it_and_the_dead_stay():
    sparse_map = plain_map(path(3))
    ids = share(sparse_map, (1, 2), 5)
    sparse_map.remove_landmarks(ids[4:])
    before, T_wk = sparse_map.lm.xyz.copy(), sparse_map.kf.T_wk.copy()
    T = se3.exp(np.array([0.3, 0.1, -0.2, 0.1, 0.2, 0.4]))
    moved = np.array([T_wk[0], T @ T_wk[1], T_wk[2]])
    loop_pose_graph.move(sparse_map, moved)
    np.testing.assert_array_equal(sparse_map.kf.T_wk, moved)
    np.testing.assert_allclose(sparse_map.lm.xyz[ids[:4]], se3.transform(T, before[ids[:4]]), atol=1e-12)
    np.testing.assert_array_equal(sparse_map.lm.xyz[ids[4]], before[ids[4]])
