import re
import shutil
import subprocess
import tracemalloc
from pathlib import Path

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from octrees import as_leaves, same, trees

from slamcli.dense.occupancy import OccupancyMap
from slamcli.errors import SlamError
from slamcli.formats import octomap
from slamcli.geometry.octree import DEPTH, Octree, expand, prune

HEADER = "# Octomap OcTree file\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"


@pytest.fixture(scope="module")
def tree() -> Octree:
    """A small map with leaves of several sizes."""
    rng = np.random.default_rng(0)
    grid = OccupancyMap(0.05, hit=0.7, miss=0.4, clamp_min=0.1192, clamp_max=0.971)
    direction = rng.normal(size=(4000, 3))
    points = 1.5 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    for _ in range(12):
        grid.insert(points + rng.normal(0, 0.01, points.shape), np.zeros(3), max_range=0.0)
    return prune(grid.leaves())


def by_class(tree: Octree) -> Octree:
    """What is left of a tree in a .bt file."""
    return prune(Octree(tree.resolution, tree.key, tree.depth, np.where(tree.log_odds >= 0, np.float32(3.5), np.float32(-2.0))))


def test_reading_gives_back_what_was_written(tree: Octree, tmp_path: Path) -> None:
    assert len(np.unique(tree.depth)) >= 3
    for parents in ("max", "mean"):
        octomap.write_ot(tmp_path / "map.ot", tree, parents=parents)
        assert same(octomap.read(tmp_path / "map.ot"), tree)
    octomap.write_bt(tmp_path / "map.bt", tree)
    assert same(octomap.read(tmp_path / "map.bt"), by_class(tree))
    assert octomap.read(tmp_path / "map.bt").resolution == 0.05


@settings(deadline=None, max_examples=50)
@given(trees())
def test_any_tree_survives_both_formats(tmp_path_factory: pytest.TempPathFactory, tree: Octree) -> None:
    folder = tmp_path_factory.mktemp("any")
    for small in (tree, prune(tree)):
        octomap.write_ot(folder / "map.ot", small)
        octomap.write_bt(folder / "map.bt", small)
        assert same(octomap.read(folder / "map.ot"), small)
        assert same(octomap.read(folder / "map.bt"), by_class(small))


def test_a_node_is_five_bytes_and_a_mean_is_over_eight_children(tmp_path: Path) -> None:
    tree = Octree(0.1, np.array([0, 1, 2]), np.full(3, DEPTH, np.uint8), np.float32([0.8, 2.4, -1.6]))
    for parents in ("max", "mean"):
        octomap.write_ot(tmp_path / "map.ot", tree, parents=parents)
        data = (tmp_path / "map.ot").read_bytes()
        assert data.startswith(f"{HEADER}id OcTree\nsize 19\nres 0.1\ndata\n".encode())
        nodes = np.frombuffer(data[-19 * 5 :], dtype=octomap.NODE)
        expected = naive.ot_nodes(as_leaves(tree), parents)
        assert nodes["children"].tolist() == [mask for _, mask in expected]
        np.testing.assert_allclose(nodes["log_odds"], [value for value, _ in expected], rtol=1e-6)


def test_an_empty_tree_can_be_written_and_read(tmp_path: Path) -> None:
    empty = Octree(0.05, np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.float32))
    octomap.write_ot(tmp_path / "map.ot", empty)
    octomap.write_bt(tmp_path / "map.bt", empty)
    assert len(octomap.read(tmp_path / "map.ot")) == len(octomap.read(tmp_path / "map.bt")) == 0


def test_a_world_that_is_one_leaf_can_be_written_and_read(tmp_path: Path) -> None:
    world = Octree(0.05, np.zeros(1, np.int64), np.zeros(1, np.uint8), np.float32([3.5]))
    octomap.write_ot(tmp_path / "map.ot", world)
    assert same(octomap.read(tmp_path / "map.ot"), world)


# Against the library and its tools


def needs_tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} (Debian: octomap-tools) is not on PATH")
    return path


def run(*command: object) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def files(tree: Octree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    octomap.write_ot(folder / "map.ot", tree)
    octomap.write_bt(folder / "map.bt", tree)
    return folder


def test_the_library_reads_our_files_and_writes_the_same_bytes(tree: Octree, files: Path, tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", reason="the C++ library, in the extra 'test', is not installed")
    from_bt = pyoctomap.OcTree(0.1)
    assert from_bt.readBinary(str(files / "map.bt"))
    from_ot = pyoctomap.OcTree(0.1).read(str(files / "map.ot"))
    for theirs, name in ((from_bt, "map.bt"), (from_ot, "map.ot")):
        assert theirs.getResolution() == 0.05
        header = (files / name).read_bytes().split(b"data\n")[0]
        assert f"size {theirs.size()}\n".encode() in header
    from_bt.writeBinary(str(tmp_path / "again.bt"))
    from_ot.write(str(tmp_path / "again.ot"))
    for name in ("bt", "ot"):
        assert (tmp_path / f"again.{name}").read_bytes() == (files / f"map.{name}").read_bytes()
    centre, occupied = tree.centre, tree.is_occupied()
    for i in range(0, len(tree), 97):
        node = from_bt.search(centre[i])
        assert from_bt.isNodeOccupied(node) == occupied[i]


def test_the_library_finds_our_colours_and_writes_the_same_bytes(tree: Octree, tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap", reason="the C++ library, in the extra 'test', is not installed")
    rng = np.random.default_rng(1)
    occupied = tree.is_occupied()
    leaf = np.repeat(np.flatnonzero(occupied)[::2], 3)  # three points in every other occupied leaf, and stray ones
    xyz = tree.centre[leaf] + rng.uniform(-0.4, 0.4, (len(leaf), 3)) * tree.side[leaf, None]
    rgb = rng.integers(0, 256, (len(leaf), 3)).astype(np.uint8)
    stray = np.array([[1e7, 0.0, 0.0], tree.centre[np.flatnonzero(~occupied)[0]]])
    n = octomap.write_colour_ot(
        tmp_path / "map.ot", tree, np.vstack([xyz, stray]), np.vstack([rgb, [[9, 9, 9], [9, 9, 9]]]).astype(np.uint8)
    )
    theirs = pyoctomap.ColorOcTree(0.1).read(str(tmp_path / "map.ot"))
    assert theirs.size() == n and theirs.getTreeType() == "ColorOcTree"
    expected = np.rint(rgb.reshape(-1, 3, 3).mean(axis=1))
    for k, i in enumerate(np.flatnonzero(occupied)[::2]):
        node = theirs.search(tree.centre[i])
        assert tuple(node.getColor()) == tuple(expected[k])
        assert node.getLogOdds() == tree.log_odds[i]
    for i in np.concatenate([np.flatnonzero(occupied)[1::2], np.flatnonzero(~occupied)])[::97]:
        assert tuple(theirs.search(tree.centre[i]).getColor()) == (octomap.NO_COLOUR,) * 3
    theirs.write(str(tmp_path / "again.ot"))
    assert (tmp_path / "again.ot").read_bytes() == (tmp_path / "map.ot").read_bytes()
    assert same(octomap.read(tmp_path / "map.ot"), tree)


def test_compare_octrees_finds_no_difference(files: Path, tmp_path: Path) -> None:
    tool = needs_tool("compare_octrees")
    run(needs_tool("convert_octree"), files / "map.ot", tmp_path / "theirs.ot")
    out = run(tool, files / "map.ot", tmp_path / "theirs.ot")
    (divergence,) = re.findall(r"KLD: ([-+.\deE]+|nan|inf)", out)
    assert abs(float(divergence)) < 1e-9, out


def test_convert_octree_turns_our_ot_into_our_bt_and_back(files: Path, tree: Octree, tmp_path: Path) -> None:
    tool = needs_tool("convert_octree")
    run(tool, files / "map.ot", tmp_path / "theirs.bt")
    assert same(octomap.read(tmp_path / "theirs.bt"), by_class(tree))
    run(tool, files / "map.bt", tmp_path / "theirs.ot")
    assert (octomap.read(tmp_path / "theirs.ot").log_odds >= 0).sum() == by_class(tree).is_occupied().sum()


def test_bt2vrml_draws_as_many_cubes_as_there_are_occupied_leaves(files: Path, tree: Octree, tmp_path: Path) -> None:
    shutil.copy(files / "map.bt", tmp_path / "map.bt")
    run(needs_tool("bt2vrml"), tmp_path / "map.bt")
    assert (tmp_path / "map.bt.wrl").read_text().count("translation") == by_class(tree).is_occupied().sum()


# Hostile files


def damaged(files: Path, folder: Path, name: str, change) -> Path:
    data = (files / name).read_bytes()
    path = folder / name
    path.write_bytes(change(data))
    return path


def with_size(data: bytes, size: str) -> bytes:
    head, sep, body = data.partition(b"data\n")
    lines = [b"size " + size.encode() if line.startswith(b"size") else line for line in head.split(b"\n")]
    return b"\n".join(lines) + sep + body


@pytest.mark.parametrize("name", ["map.ot", "map.bt"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"", "not an OctoMap file"),
        (lambda data: b"\x00" * 5000, "not an OctoMap file"),
        (lambda data: data[:60], "no line 'data'"),
        (lambda data: data.replace(b"data\n", b"#" * 9000), "no line 'data'"),
        (lambda data: data.replace(b"id OcTree", b"id OcTreeStamped"), "only OcTree"),
        (lambda data: data.replace(b"res 0.05", b"res nan"), "res is nan"),
        (lambda data: data.replace(b"res 0.05", b"res -1"), "res is -1"),
        (lambda data: data.replace(b"res 0.05", b"res x"), "not a number"),
        (lambda data: data.replace(b"res 0.05\n", b""), "no 'res'"),
        (lambda data: with_size(data, "-5"), "size is -5"),
        (lambda data: with_size(data, "400000000"), "cut off"),
        (lambda data: with_size(data, "1" * 5000), "header"),
        (lambda data: with_size(data, "3"), "more nodes than"),
        (lambda data: data[:-40], "cut off"),
        (lambda data: data + b"\x00" * 10, "bytes follow"),
    ],
)
def test_damaged_files_give_one_line_and_little_memory(files: Path, tmp_path: Path, name: str, change, message: str) -> None:
    path = damaged(files, tmp_path, name, change)
    tracemalloc.start()
    with pytest.raises(SlamError, match=message) as error:
        octomap.read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    assert peak < 20 * path.stat().st_size + 1_000_000


def test_a_tree_without_the_colours_it_claims_is_cut_off(files: Path, tmp_path: Path) -> None:
    path = damaged(files, tmp_path, "map.ot", lambda data: data.replace(b"id OcTree", b"id ColorOcTree"))
    with pytest.raises(SlamError, match="cut off"):
        octomap.read(path)


def test_log_odds_that_are_not_finite_are_refused(files: Path, tmp_path: Path) -> None:
    for value in (np.nan, np.inf):
        path = damaged(files, tmp_path, "map.ot", lambda data, v=value: data[:-5] + np.float32(v).tobytes() + b"\x00")
        with pytest.raises(SlamError, match="finite"):
            octomap.read(path)


@pytest.mark.parametrize("suffix", ["ot", "bt"])
def test_a_branch_deeper_than_sixteen_levels_is_refused(tmp_path: Path, suffix: str) -> None:
    node = b"\x00\x00\x00\x00\x01" if suffix == "ot" else b"\x03\x00"
    first = "# Octomap OcTree file" if suffix == "ot" else "# Octomap OcTree binary file"
    (tmp_path / "deep").write_bytes(f"{first}\nid OcTree\nsize 40\nres 0.1\ndata\n".encode() + node * 40)
    with pytest.raises(SlamError, match="deeper"):
        octomap.read(tmp_path / "deep")


@settings(deadline=None, max_examples=200)
@given(noise=st.tuples(st.integers(0, 60), st.binary(max_size=200)))
def test_no_bytes_break_the_reader(noise: tuple[int, bytes], tmp_path_factory: pytest.TempPathFactory) -> None:
    size, body = noise
    for first in ("# Octomap OcTree file", "# Octomap OcTree binary file"):
        path = tmp_path_factory.getbasetemp() / "noise"
        path.write_bytes(f"{first}\nid OcTree\nsize {size}\nres 0.1\ndata\n".encode() + body)
        try:
            tree = octomap.read(path)
        except SlamError:
            continue
        assert (np.diff(tree.key) > 0).all()
        assert len(expand(Octree(0.1, tree.key, np.maximum(tree.depth, 14), tree.log_odds))) >= len(tree)
