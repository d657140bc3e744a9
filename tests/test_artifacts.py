"""Records of arrays: what is saved comes back, and nothing that a type does not declare gets in or out."""

import dataclasses
import io
import os
import pickle
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli import artifacts, files, schema
from slamcli.datasets import lists
from slamcli.errors import SlamError
from slamcli.schema import array


@dataclass(frozen=True)
class Ragged:
    """A type with every kind of shape."""

    offset: np.ndarray = array("i8", "F+1", "rows")
    xy: np.ndarray = array("f4", "M 2", "px")
    depth: np.ndarray = array("f4", "M", "m", values=schema.OR_NAN)
    total: np.ndarray = array("f8", "", "scalar")
    is_found: np.ndarray = array("?", "", "scalar")


def ragged(frames: int = 2, rows: int = 5) -> Ragged:
    values = np.arange(2 * rows, dtype="f4").reshape(rows, 2)
    return Ragged(np.zeros(frames + 1, "i8"), values, np.full(rows, np.nan, "f4"), np.float64(0.1), np.bool_(True))


def test_files_are_those_that_numpy_writes(tmp_path: Path) -> None:
    artifacts.save(ragged(), tmp_path)
    for spec in dataclasses.fields(Ragged):
        buffer = io.BytesIO()
        np.save(buffer, getattr(ragged(), spec.name))
        assert (tmp_path / f"{spec.name}.npy").read_bytes() == buffer.getvalue()


@given(frames=st.integers(0, 5), rows=st.integers(0, 7))
def test_load_gives_what_save_got(tmp_path_factory: pytest.TempPathFactory, frames: int, rows: int) -> None:
    folder, value = tmp_path_factory.mktemp("record"), ragged(frames, rows)
    artifacts.save(value, folder)
    back = artifacts.load(Ragged, folder)
    for spec in dataclasses.fields(Ragged):
        before, after = np.asarray(getattr(value, spec.name)), getattr(back, spec.name)
        assert type(after) is np.ndarray
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after, before)


def test_the_same_value_gives_the_same_bytes_whatever_its_memory_layout(tmp_path: Path) -> None:
    value = ragged(2, 4)
    for name, laid_out in (("c", value.xy), ("fortran", np.asfortranarray(value.xy)), ("strided", np.repeat(value.xy, 2, axis=0)[::2])):
        (tmp_path / name).mkdir()
        artifacts.save(dataclasses.replace(value, xy=laid_out), tmp_path / name)
    contents = {(tmp_path / name / "xy.npy").read_bytes() for name in ("c", "fortran", "strided")}
    assert len(contents) == 1


def test_writing_to_a_loaded_array_never_reaches_the_file(tmp_path: Path) -> None:
    artifacts.save(ragged(), tmp_path)
    artifacts.load(Ragged, tmp_path).xy[:] = -1.0
    np.testing.assert_array_equal(artifacts.load(Ragged, tmp_path).xy, ragged().xy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": np.zeros(4, "f4")}, r"Ragged.depth: shape \(4,\) does not fit \['M'\] with {'F': 2, 'M': 5}"),
        ({"depth": np.zeros(5, "f8")}, "Ragged.depth: dtype float64 is not float32"),
        ({"xy": np.zeros((5, 3), "f4")}, r"Ragged.xy: shape \(5, 3\) does not fit"),
        ({"xy": np.zeros(5, "f4")}, r"Ragged.xy: shape \(5,\) does not fit"),
        ({"offset": np.zeros(0, "i8")}, r"Ragged.offset: shape \(0,\) does not fit \['F\+1'\]"),
        ({"total": np.zeros(1)}, r"Ragged.total: shape \(1,\) does not fit \[\]"),
        ({"is_found": 1}, "Ragged.is_found: dtype int64 is not bool"),
    ],
)
def test_what_does_not_fit_the_declaration_is_never_saved(tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        artifacts.save(dataclasses.replace(ragged(), **change), tmp_path)
    assert not list(tmp_path.iterdir())


@dataclass(frozen=True)
class Bounded:
    """A type with every kind of bound."""

    stamp: np.ndarray = array("f8", "F", "s", values=schema.STAMP)
    offset: np.ndarray = array("i8", "F+1", "rows of a frame", values=schema.Values(delimits="M"))
    octave: np.ndarray = array("u1", "M", "level", values=schema.Values(most=7))
    depth: np.ndarray = array("f4", "M", "m", values=schema.OR_NAN)
    frame: np.ndarray = array("i4", "P", "frame", narrow="u1", widen=True, values=schema.Values(below="F"))
    parent: np.ndarray = array("i4", "P", "frame, -1 = none", values=schema.Values(least=-1, below="F"))
    landmark: np.ndarray = array("i4", "P", "landmark of another type", values=schema.Values(below="L"))
    T_wc: np.ndarray = array("f8", "P 4 4", "pose")
    T_kc: np.ndarray = array("f8", "P 4 4", "pose, NaN = none", values=schema.OR_NAN)


@dataclass(frozen=True)
class Lacking:
    """A type beside it that may have no rows."""

    lacks: np.ndarray = array("f8", "F 2", "may lack", may_lack=True)


def bounded(**change: object) -> Bounded:
    whole, lost = np.tile(np.eye(4), (2, 1, 1)), np.stack([np.eye(4), np.full((4, 4), np.nan)])
    value = Bounded(
        stamp=np.array([1.0, 2.0]), offset=np.array([0, 1, 3]), octave=np.array([0, 7, 0], "u1"), depth=np.array([1, np.nan, 2], "f4"),
        frame=np.array([0, 1], "i4"), parent=np.array([-1, 1], "i4"), landmark=np.array([0, 4], "i4"), T_wc=whole, T_kc=lost,
    )  # fmt: skip
    return dataclasses.replace(value, **change)


def write_unchecked(value: Bounded, folder: Path) -> None:
    for spec in dataclasses.fields(value):
        np.save(folder / f"{spec.name}.npy", getattr(value, spec.name))
    np.save(folder / "lm_xyz.npy", np.zeros((5, 3)))  # of another type: there are five landmarks


def turned(shear: float) -> np.ndarray:
    return np.tile(np.array([[1, shear, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), (2, 1, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stamp": np.array([1.0, 1e20])}, r"Bounded.stamp: 1e\+20 is more than 1e\+19"),
        ({"stamp": np.array([2.0, 1.0])}, "Bounded.stamp: not in increasing order"),
        ({"stamp": np.array([np.nan, 1.0])}, "Bounded.stamp: a value is missing"),
        ({"offset": np.array([0, 4, 3])}, "Bounded.offset: does not divide 3 rows"),
        ({"offset": np.array([1, 1, 3])}, "Bounded.offset: does not divide 3 rows"),
        ({"offset": np.array([0, 1, 4])}, "Bounded.offset: does not divide 3 rows"),
        ({"offset": np.array([0, -1, 3])}, "Bounded.offset: does not divide 3 rows"),
        ({"octave": np.array([0, 8, 0], "u1")}, "Bounded.octave: 8 is more than 7"),
        ({"depth": np.array([1, np.inf, 2], "f4")}, r"Bounded.depth: inf is more than 1e\+09"),
        ({"depth": np.array([1, -2e9, 2], "f4")}, r"Bounded.depth: -2e\+09 is less than -1e\+09"),
        ({"frame": np.array([0, 2], "i4")}, "Bounded.frame: row 2 of 2"),
        ({"frame": np.array([0, -1], "i4")}, "Bounded.frame: -1 is less than 0"),
        ({"parent": np.array([0, -2], "i4")}, "Bounded.parent: -2 is less than -1"),
        ({"parent": np.array([0, 2], "i4")}, "Bounded.parent: row 2 of 2"),
        ({"landmark": np.array([0, 5], "i4")}, "Bounded.landmark: row 5 of 5"),
        ({"T_wc": np.zeros((2, 4, 4))}, "Bounded.T_wc: not a rigid motion"),
        ({"T_wc": turned(0.01)}, "Bounded.T_wc: not a rigid motion"),
        ({"T_wc": np.stack([np.eye(4), np.full((4, 4), np.nan)])}, "Bounded.T_wc: a value is missing"),
        ({"T_kc": np.stack([np.eye(4), np.diag([np.nan, 1, 1, 1])])}, "Bounded.T_kc: not a rigid motion"),
    ],
)
def test_values_that_no_stage_writes_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    write_unchecked(bounded(**change), tmp_path)
    with pytest.raises(SlamError, match=message):
        artifacts.load(Bounded, tmp_path)


def test_values_within_their_bounds_are_read(tmp_path: Path) -> None:
    write_unchecked(bounded(T_wc=turned(1e-6), landmark=np.array([4, 4], "i4")), tmp_path)
    assert artifacts.load(Bounded, tmp_path).offset.tolist() == [0, 1, 3]


@pytest.mark.parametrize("stamp", [[-lists.LARGEST_STAMP, 0.0], [5e10, 5e10 + 0.1], [0.0, lists.LARGEST_STAMP]])
def test_every_stamp_that_a_recording_may_have_can_be_read_back(tmp_path: Path, stamp: list[float]) -> None:
    write_unchecked(bounded(stamp=np.array(stamp)), tmp_path)
    assert artifacts.load(Bounded, tmp_path).stamp.tolist() == stamp


def test_rows_of_what_is_read_with_it_are_compared(tmp_path: Path) -> None:
    write_unchecked(bounded(), tmp_path)
    assert artifacts.lengths(tmp_path) == {"F": 2, "M": 3, "L": 5}
    for rows in (0, 2):
        np.save(tmp_path / "lacks.npy", np.zeros((rows, 2)))
        assert len(artifacts.load(Lacking, tmp_path).lacks) == rows
    np.save(tmp_path / "lacks.npy", np.zeros((1, 2)))
    with pytest.raises(SlamError, match=r"Lacking.lacks: shape \(1, 2\) does not fit"):
        artifacts.load(Lacking, tmp_path)
    with pytest.raises(SlamError, match=r"stamp.npy: 2 rows do not fit {'F': 3} of what is read with it"):
        artifacts.lengths(tmp_path, {"F": 3})
    (tmp_path / "stamp.npy").write_bytes(hostile("objects", b""))
    with pytest.raises(SlamError, match=r"not what this version of slamcli writes \(stamp.npy"):
        artifacts.lengths(tmp_path)


def test_values_are_compared_once_for_a_file_that_nobody_wrote_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compared, inner = [], artifacts.check_values
    monkeypatch.setattr(artifacts, "check_values", lambda value, known: compared.append(known) or inner(value, known))
    write_unchecked(bounded(), tmp_path)
    for path in tmp_path.iterdir():
        os.utime(path, ns=(10**18, 10**18))
    time.sleep(2 * files.TICK_NS / 1e9)
    known = artifacts.lengths(tmp_path)
    for _ in range(2):
        artifacts.load(Bounded, tmp_path, known)
    assert compared == [known]
    with pytest.raises(SlamError, match="row 4 of 1"):  # among fewer
        artifacts.load(Bounded, tmp_path, {**known, "L": 1})
    np.save(tmp_path / "landmark.npy", np.array([0, 9], "i4"))
    with pytest.raises(SlamError, match="row 9 of 5"):
        artifacts.load(Bounded, tmp_path, known)


def test_two_types_in_one_folder_must_not_share_a_field(tmp_path: Path) -> None:
    artifacts.save(ragged(), tmp_path)
    with pytest.raises(ValueError, match="offset.npy is already written"):
        artifacts.save(ragged(), tmp_path)


def hostile(kind: str, good: bytes) -> bytes:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (4611686018427387904,), }"
    text = {
        "empty": b"",
        "cut in the data": good[:-4],
        "cut in the header": good[:20],
        "not npy": b"PK\x03\x04 nothing of the kind",
        "pickle": pickle.dumps([1, 2]),
        "enormous": b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header,
        "code in the header": b"\x93NUMPY\x01\x00" + (20).to_bytes(2, "little") + b"__import__('os')    ",
    }
    if kind == "objects":
        buffer = io.BytesIO()
        np.save(buffer, np.array([{}], dtype=object), allow_pickle=True)
        return buffer.getvalue()
    if kind == "other dtype":
        buffer = io.BytesIO()
        np.save(buffer, np.zeros(5, "f8"))
        return buffer.getvalue()
    return text[kind]


@pytest.mark.parametrize(
    "kind",
    [
        "empty",
        "cut in the data",
        "cut in the header",
        "not npy",
        "pickle",
        "enormous",
        "code in the header",
        "objects",
        "other dtype",
    ],
)
def test_a_damaged_or_hostile_file_gives_one_line_that_names_it(tmp_path: Path, kind: str) -> None:
    artifacts.save(ragged(), tmp_path)
    path = tmp_path / "depth.npy"
    path.write_bytes(hostile(kind, path.read_bytes()))
    with pytest.raises(SlamError, match=r"depth.*run.update\(force=True\)$") as caught:
        artifacts.load(Ragged, tmp_path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_gives_one_line_that_names_it(tmp_path: Path) -> None:
    artifacts.save(ragged(), tmp_path)
    (tmp_path / "xy.npy").unlink()
    with pytest.raises(SlamError, match="xy.npy is not there"):
        artifacts.load(Ragged, tmp_path)


@dataclass(frozen=True)
class Narrowed:
    """A type whose values are saved as narrowly as they fit."""

    row: np.ndarray = array("i4", "M", "index", narrow="i1 u2")


@pytest.mark.parametrize(
    ("values", "dtype"),
    [([], "i1"), ([-1, 127], "i1"), ([-128], "i1"), ([128], "u2"), ([0, 65535], "u2"), ([-1, 128], "i4"), ([-129], "i4"), ([65536], "i4")],
)
def test_whole_numbers_are_saved_in_the_first_type_that_holds_them_all(tmp_path: Path, values: list[int], dtype: str) -> None:
    artifacts.save(Narrowed(np.array(values, np.int32)), tmp_path)
    row = artifacts.load(Narrowed, tmp_path).row
    assert row.dtype == dtype and row.tolist() == values
    with pytest.raises(ValueError, match=r"Narrowed.row: dtype int64 is not int32"):
        artifacts.check(Narrowed(np.array(values, np.int64)))


@dataclass(frozen=True)
class Widened:
    """A type that is narrow on disk alone."""

    row: np.ndarray = array("i8", "M", "index", narrow="u1 u4", widen=True)


@pytest.mark.parametrize(
    ("values", "dtype"), [([], "u1"), ([255], "u1"), ([256], "u4"), ([2**32 - 1], "u4"), ([2**32], "i8"), ([-1], "i8"), ([-1, 2**62], "i8")]
)
def test_what_is_widened_is_narrow_on_disk_alone(tmp_path: Path, values: list[int], dtype: str) -> None:
    artifacts.save(Widened(np.array(values, np.int64)), tmp_path)
    assert np.load(tmp_path / "row.npy").dtype == dtype
    row = artifacts.load(Widened, tmp_path).row
    assert row.dtype == np.int64 and row.tolist() == values
    row[:] = 7
    assert artifacts.load(Widened, tmp_path).row.tolist() == values
    with pytest.raises(ValueError, match=r"Widened.row: dtype uint8 is not int64"):
        artifacts.check(Widened(np.array(values).astype(np.uint8)))


def test_of_what_is_widened_another_type_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "row.npy", np.zeros(3, np.int32))
    with pytest.raises(SlamError, match=r"Widened.row: dtype int32 is not int64"):
        artifacts.load(Widened, tmp_path)


def test_every_core_type_declares_dtype_shape_and_meaning_of_each_field() -> None:
    types = [value for value in vars(schema).values() if isinstance(value, type) and dataclasses.is_dataclass(value)]
    types.remove(schema.Values)
    assert len(types) >= 8
    for kind in types:
        for spec in dataclasses.fields(kind):
            assert isinstance(spec.metadata["dtype"], np.dtype), f"{kind.__name__}.{spec.name}"
            assert spec.metadata["meaning"], f"{kind.__name__}.{spec.name}"


def written_by_parts(folder: Path, value: Ragged, parts: int) -> Ragged:
    with artifacts.Writer(Ragged, folder, "xy", "depth") as writer:
        for xy, depth in zip(np.array_split(value.xy, parts), np.array_split(value.depth, parts), strict=True):
            writer.append(xy=xy, depth=depth)
        return writer.finish(offset=value.offset, total=value.total, is_found=value.is_found)


@given(rows=st.integers(0, 12), parts=st.integers(1, 5))
def test_rows_that_come_a_few_at_a_time_give_the_files_of_the_whole(
    tmp_path_factory: pytest.TempPathFactory, rows: int, parts: int
) -> None:
    whole, by_parts = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("parts")
    value = ragged(2, rows)
    artifacts.save(value, whole)
    back = written_by_parts(by_parts, value, parts)
    np.testing.assert_array_equal(back.xy, value.xy)
    assert {path.name: path.read_bytes() for path in by_parts.iterdir()} == {path.name: path.read_bytes() for path in whole.iterdir()}


@given(parts=st.lists(st.lists(st.sampled_from([-(2**31), -129, -128, -1, 0, 1, 127, 128, 65535, 65536]), max_size=3), max_size=5))
def test_whole_numbers_that_come_a_few_at_a_time_are_in_the_type_that_holds_them_all(
    tmp_path_factory: pytest.TempPathFactory, parts: list[list[int]]
) -> None:
    whole, by_parts = tmp_path_factory.mktemp("whole"), tmp_path_factory.mktemp("parts")
    artifacts.save(Narrowed(np.array([n for part in parts for n in part], np.int32)), whole)
    with artifacts.Writer(Narrowed, by_parts, "row") as writer:
        for part in parts:
            writer.append(row=np.array(part, np.int32))
        writer.finish()
    assert (by_parts / "row.npy").read_bytes() == (whole / "row.npy").read_bytes()


@pytest.mark.parametrize("rows", [np.zeros((3, 2), "f8"), np.zeros((3, 3), "f4"), np.zeros(3, "f4")])
def test_rows_that_do_not_fit_the_declaration_are_not_written(tmp_path: Path, rows: np.ndarray) -> None:
    with artifacts.Writer(Ragged, tmp_path, "xy", "depth") as writer, pytest.raises(ValueError, match="xy"):
        writer.append(xy=rows)


def test_fields_of_unequal_length_are_refused_in_the_end(tmp_path: Path) -> None:
    value = ragged()
    with artifacts.Writer(Ragged, tmp_path, "xy", "depth") as writer:
        writer.append(xy=value.xy[:4], depth=value.depth)
        with pytest.raises(SlamError, match=r"Ragged.depth: shape \(5,\)"):
            writer.finish(offset=value.offset, total=value.total, is_found=value.is_found)


def test_a_writer_takes_no_file_of_another_type(tmp_path: Path) -> None:
    artifacts.save(ragged(), tmp_path)
    with pytest.raises(ValueError, match="xy.npy is already written"):
        artifacts.Writer(Ragged, tmp_path, "xy")
