"""DBoW2's text format: there and back, and what is no such file."""

from pathlib import Path

import numpy as np
import pytest

from slamcli.errors import SlamError
from slamcli.formats import dbow2
from slamcli.vision import kmeans, vocabulary

NODE = " ".join(["7"] * 32)
GOOD = f"3 2 0 0\n0 0 {NODE} 0\n0 1 {NODE} 1.5\n1 1 {NODE} 0.25\n1 1 {NODE} 2"


@pytest.fixture
def text(tmp_path: Path) -> Path:
    return tmp_path / "voc.txt"


def test_a_small_file_is_read_as_it_stands(text: Path) -> None:
    text.write_text(GOOD + "\n")
    tree = dbow2.read(text)
    assert (tree.branching, tree.depth) == (3, 2)
    assert tree.parent.tolist() == [0, 0, 1, 1]
    assert tree.weight.tolist() == [0.0, 1.5, 0.25, 2.0]
    assert (tree.centre == 7).all() and tree.centre.shape == (4, 32)


def test_there_and_back(text: Path) -> None:
    desc = np.random.default_rng(0).integers(0, 256, (300, 32)).astype(np.uint8)
    made = kmeans.train(np.array_split(desc, 6), branching=4, depth=3, rng=np.random.default_rng(0))
    dbow2.write(text, dbow2.Tree(made.branching, made.depth, made.parent, made.centre[1:], made.node_weight))
    assert not text.read_bytes().endswith(b"\n")
    tree = dbow2.read(text)
    back = vocabulary.from_parents(tree.parent, tree.centre, tree.weight, origin="", source="test")
    for name in ("centre", "first_child", "idf"):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))


def test_blocks_smaller_than_the_file_change_nothing(text: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text.write_text(GOOD)
    whole = dbow2.read(text)
    monkeypatch.setattr(dbow2, "BLOCK", 130)
    for name in ("parent", "centre", "weight"):
        np.testing.assert_array_equal(getattr(dbow2.read(text), name), getattr(whole, name))


@pytest.mark.parametrize(
    "content, fault",
    [
        ("", "line 1"),
        ("hello\n", "line 1"),
        ("10 6 0\n", "line 1"),
        ("99 6 0 0\n" + GOOD[8:], "99 children"),
        ("10 6 1 0\n" + GOOD[8:], "scoring 1"),
        ("10 6 0 0\n", "no nodes"),
        (GOOD[:-40], "line 5 has .* numbers"),
        (GOOD.rsplit("\n", 2)[0], "no children: is the file cut off"),
        (GOOD.replace("1.5", "nan"), "line 3: its weight"),
        (GOOD.replace("1.5", "-1"), "line 3: its weight"),
        (GOOD.replace("1.5", "x"), "no number"),
        (GOOD.replace("7 7 0\n", "7 256 0\n"), "line 2: its descriptor"),
        (GOOD.replace("7 7 0\n", "7 1.5 0\n"), "line 2: its descriptor"),
        (GOOD.replace("\n1 1 ", "\n9 1 "), "line 4: its parent"),
        (GOOD.replace("\n0 1 ", "\n0 2 "), "line 3: its leaf mark"),
        (GOOD.replace("\n0 0 ", "\n0 1 "), "line 2: a leaf has children"),
        (GOOD + f"\n0 1 {NODE} 1" * 3, "node 0 has 5 children"),
        (GOOD.replace("7 7 0.25", "7 7\u00e9 0.25"), "no number|numbers"),
        ("3 2 0 0\n" + "7" * 5000, "numbers"),
    ],
)
def test_what_is_malformed_gives_one_line_that_says_where(text: Path, content: str, fault: str) -> None:
    text.write_text(content, encoding="utf-8")
    with pytest.raises(SlamError, match=fault) as caught:
        dbow2.read(text)
    assert str(caught.value).startswith(str(text)) and "\n" not in str(caught.value)


def test_oversized_and_missing_files_are_refused_before_reading(text: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SlamError, match="cannot be read"):
        dbow2.read(text)
    with text.open("wb") as file:
        file.truncate(dbow2.MAX_BYTES + 1)  # sparse
    with pytest.raises(SlamError, match="too large"):
        dbow2.read(text)
    text.write_text(GOOD)
    monkeypatch.setattr(dbow2, "MAX_NODES", 3)
    with pytest.raises(SlamError, match="more than 3 nodes"):
        dbow2.read(text)


def test_a_line_without_end_is_refused(text: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dbow2, "BLOCK", 64)
    text.write_text("3 2 0 0\n" + "7 " * 4000)
    with pytest.raises(SlamError, match="too long"):
        dbow2.read(text)


def test_a_tree_that_dbow2_cannot_hold_is_not_written(text: Path) -> None:
    tree = dbow2.Tree(21, 2, np.zeros(21, np.int32), np.zeros((21, 32), np.uint8), np.ones(21, np.float32))
    with pytest.raises(SlamError, match="at most 20 children"):
        dbow2.write(text, tree)
    assert not text.exists()
