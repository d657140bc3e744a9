"""Files of vocabularies: back as written, and one line for whatever is damaged."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import word_groups

from slamcli.errors import SlamError
from slamcli.formats import vocabulary_file
from slamcli.vision.vocabulary import Vocabulary


@pytest.fixture
def small() -> Vocabulary:
    return word_groups.tree()


def test_a_file_written_anew_is_read_anew(small: Vocabulary, tmp_path: Path) -> None:
    vocabulary_file.write(tmp_path / "v.npz", small)
    assert vocabulary_file.read(tmp_path / "v.npz").origin == "groups"
    vocabulary_file.write(tmp_path / "v.npz", Vocabulary(small.centre, small.first_child, small.idf, "others"))
    assert vocabulary_file.read(tmp_path / "v.npz").origin == "others"


def test_a_saved_vocabulary_is_read_back(small: Vocabulary, tmp_path: Path) -> None:
    path = tmp_path / "words.any_suffix"
    vocabulary_file.write(path, small)
    read = vocabulary_file.read(path)
    for name in ("centre", "first_child", "idf"):
        np.testing.assert_array_equal(getattr(read, name), getattr(small, name))
        assert getattr(read, name).flags.writeable
    assert read.origin == "groups"


def test_the_shipped_vocabulary_is_what_it_should_be() -> None:
    shipped = vocabulary_file.read()
    assert shipped.n_words >= 10_000
    assert vocabulary_file.SHIPPED.stat().st_size <= 5_000_000
    assert "held out" in shipped.origin
    assert 0.0 < np.median(shipped.idf) < 10.0


def damaged(small: Vocabulary, **changes: np.ndarray) -> bytes:
    columns = {
        "format": np.int32(1),
        "centre": small.centre,
        "first_child": small.first_child,
        "idf": small.idf,
        "origin": np.zeros(0, np.uint8),
    }
    buffer = io.BytesIO()
    np.savez(buffer, **{name: value for name, value in {**columns, **changes}.items() if value is not None})
    return buffer.getvalue()


@pytest.mark.parametrize(
    "changes, fault",
    [
        ({"idf": None}, "idf is missing"),
        ({"format": np.int32(99)}, "format 99"),
        ({"centre": np.zeros((5, 31), np.uint8)}, "centre has type"),
        ({"centre": np.zeros((5, 32), np.float64)}, "centre has type"),
        ({"idf": np.array([object()], dtype=object)}, "idf has type|unknown kind|Object"),
        ({"first_child": np.arange(3, dtype=np.int32)}, "no tree"),
        ({"first_child": "loop"}, "no tree"),
        ({"idf": np.ones(3, np.float32)}, "3 weights"),
        ({"idf": "nan"}, "weight"),
    ],
)
def test_a_damaged_vocabulary_gives_one_line(small: Vocabulary, tmp_path: Path, changes: dict, fault: str) -> None:
    if isinstance(changes.get("first_child"), str):
        first = small.first_child.copy()
        first[2] = 1  # node 1 would be its own child
        changes = {"first_child": first}
    if isinstance(changes.get("idf"), str):
        changes = {"idf": np.full_like(small.idf, np.nan)}
    path = tmp_path / "bad.npz"
    path.write_bytes(damaged(small, **changes))
    with pytest.raises(SlamError, match=fault) as caught:
        vocabulary_file.read(path)
    assert "bad.npz" in str(caught.value) and "\n" not in str(caught.value)


def test_a_cut_a_foreign_and_a_missing_file_give_one_line(small: Vocabulary, tmp_path: Path) -> None:
    whole = damaged(small)
    contents = {"cut.npz": whole[: len(whole) // 2], "empty.npz": b"", "text.npz": b"10 6 0 0\n0 0 1 2 3"}
    with zipfile.ZipFile(tmp_path / "short.npz", "w") as archive, zipfile.ZipFile(io.BytesIO(whole)) as original:
        for name in original.namelist():
            archive.writestr(name, original.read(name)[:-3] if name == "centre.npy" else original.read(name))
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    for name in [*contents, "short.npz", "missing.npz"]:
        with pytest.raises(SlamError, match=name) as caught:
            vocabulary_file.read(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_header_that_promises_too_much_reserves_nothing(small: Vocabulary, tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (10**12, 32)})
    with zipfile.ZipFile(tmp_path / "huge.npz", "w") as archive, zipfile.ZipFile(io.BytesIO(damaged(small))) as original:
        for name in original.namelist():
            archive.writestr(name, header.getvalue() if name == "centre.npy" else original.read(name))
    with pytest.raises(SlamError, match="rows"):
        vocabulary_file.read(tmp_path / "huge.npz")
