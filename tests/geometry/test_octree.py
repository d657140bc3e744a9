import naive
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from octrees import as_leaves, same, trees

from slamcli.geometry import voxel
from slamcli.geometry.octree import Octree, expand, levels, preorder, prune


@settings(deadline=None)
@given(trees())
def test_pruning_merges_what_the_slow_twin_merges(tree: Octree) -> None:
    assert as_leaves(prune(tree)) == naive.pruned(as_leaves(tree))


@settings(deadline=None)
@given(trees())
def test_pruning_is_lossless_and_final(tree: Octree) -> None:
    small = prune(tree)
    assert same(expand(small), tree)
    assert same(prune(small), small)
    assert len(small) <= len(tree)
    assert (np.diff(small.key) > 0).all()


@settings(deadline=None)
@given(trees())
def test_every_cell_is_found_in_its_leaf_and_nothing_else_is(tree: Octree) -> None:
    small, cell = prune(tree), voxel.unmorton(tree.key)
    row = small.find(cell)
    assert (small.log_odds[row] == tree.log_odds).all()
    others = np.setdiff1d(np.arange(tree.key.min() - 9 if len(tree) and tree.key.min() > 9 else 0, 8**4), tree.key)
    assert (small.find(voxel.unmorton(others)) == -1).all()
    assert (small.find(np.array([[-1, 0, 0], [0, 65536, 0]])) == -1).all()


@settings(deadline=None)
@given(trees(), st.sampled_from(["max", "mean"]))
def test_nodes_depth_first_are_those_of_a_recursion(tree: Octree, parents: str) -> None:
    tree = prune(tree)
    expected = naive.ot_nodes(as_leaves(tree), parents)
    nodes = levels(tree, parents=parents)
    found: list = [None] * len(expected)
    for level, place in zip(nodes, preorder(nodes), strict=True):
        for at, value, children in zip(place, level.log_odds, level.children, strict=True):
            assert found[at] is None
            found[at] = (value, children)
    assert [mask for _, mask in found] == [mask for _, mask in expected]
    np.testing.assert_allclose([v for v, _ in found], [v for v, _ in expected], atol=1e-6)


def test_a_leaf_knows_where_it_is() -> None:
    root = Octree(0.1, np.array([0]), np.array([0], np.uint8), np.float32([1.0]))
    assert root.side.tolist() == [6553.6]
    assert np.allclose(root.centre, 0.0)
    cell = Octree(0.1, voxel.morton([[32768, 32769, 32767]]), np.array([16], np.uint8), np.float32([1.0]))
    np.testing.assert_allclose(cell.centre, [[0.05, 0.15, -0.05]])
    assert cell.cells(cell.centre).tolist() == [[32768, 32769, 32767]]


def test_an_empty_tree_has_no_nodes() -> None:
    empty = Octree(0.05, np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.float32))
    assert len(prune(empty)) == len(expand(empty)) == 0
    assert sum(len(level.prefix) for level in levels(empty)) == 0
    assert empty.find(np.array([[1, 2, 3]])).tolist() == [-1]
