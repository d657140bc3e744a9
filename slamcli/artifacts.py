"""Records of arrays as folders of `.npy`, one file a field. A record's type is its schema; it is checked at every save and load."""

import io
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import MISSING, Field, fields
from pathlib import Path
from tokenize import TokenError
from types import MappingProxyType, TracebackType
from typing import Any, Generic, TypeVar

import numpy as np

from slamcli import files, mapped_memory, schema
from slamcli.errors import SlamError
from slamcli.hints import hint

Record = TypeVar("Record")

MOST_REMEMBERED = 256  # records whose values were compared; a run has some thirty, and stages read the large ones in turn
_counted: dict[tuple[int, ...], int | None] = {}  # rows of arrays, by the versions of their files
_sound: set[tuple[Any, ...]] = set()  # by the versions of their files and the lengths they were compared with


def check(value: Any) -> None:
    """Compare each field's dtype and shape with its declaration; ValueError names the field at fault.

    A symbol such as "M" stands for the same length in every field of the type; the first field that has it alone binds it.
    """
    bound: dict[str, int] = {}
    for spec in fields(value):
        column = np.asarray(getattr(value, spec.name))
        name, dtype, shape = f"{type(value).__name__}.{spec.name}", spec.metadata["dtype"], spec.metadata["shape"]
        if column.dtype not in (dtype, *(() if spec.metadata["widen"] else spec.metadata["narrow"])):
            raise ValueError(f"{name}: dtype {column.dtype} is not {dtype}")
        if len(column.shape) != len(shape) or not all(_fits(n, symbol, bound) for n, symbol in zip(column.shape, shape, strict=True)):
            raise ValueError(f"{name}: shape {column.shape} does not fit {list(shape)} with {bound}")


def check_values(value: Any, lengths: Mapping[str, int]) -> None:
    """Compare each field's values with its declaration; ValueError names the field at fault.

    lengths : what symbols stand for in the other types of the folder; one that neither these nor this type bind is not compared
    """
    known = dict(lengths)
    for spec in fields(value):
        shape = np.asarray(getattr(value, spec.name)).shape
        if not (spec.default_factory is not MISSING and shape[0] == 0):  # not one that lacks
            for n, symbol in zip(shape, spec.metadata["shape"], strict=True):
                if not _fits(n, symbol, known):
                    raise ValueError(f"{type(value).__name__}.{spec.name}: shape {shape} does not fit {known} of the files beside it")
    for spec in fields(value):
        column = np.asarray(getattr(value, spec.name))
        if column.size and column.dtype.kind in "iuf" and (fault := _fault(column, spec, known)):
            raise ValueError(f"{type(value).__name__}.{spec.name}: {fault}")


def _fault(column: np.ndarray, spec: Field, lengths: Mapping[str, int]) -> str:
    """Say what is wrong with the values of a field, or ""."""
    may_be, is_real = spec.metadata["values"], column.dtype.kind == "f"
    least, most = column.min(), column.max()
    if is_nan := bool(np.isnan(least)):
        least, most = np.fmin.reduce(column, axis=None), np.fmax.reduce(column, axis=None)  # which pass NaN over, and take longer
    if may_be.least is not None and least < may_be.least:
        return f"{least:.9g} is less than {may_be.least:g}"
    if may_be.most is not None and most > may_be.most:
        return f"{most:.9g} is more than {may_be.most:g}"
    if may_be.below in lengths and most >= lengths[may_be.below]:
        return f"row {most} of {lengths[may_be.below]}"
    if may_be.delimits and (column[0] != 0 or column[-1] != lengths[may_be.delimits] or (column[1:] < column[:-1]).any()):
        return f"does not divide {lengths[may_be.delimits]} rows"
    if may_be.is_sorted and (column[1:] < column[:-1]).any():
        return "not in increasing order"
    if is_real and spec.metadata["shape"][-2:] == ("4", "4"):
        return _not_rigid(column.reshape(-1, 4, 4), may_be_nan=may_be.nan)
    return "a value is missing" if is_nan and not may_be.nan else ""


def _not_rigid(T: np.ndarray, *, may_be_nan: bool) -> str:
    """Say what keeps matrices (N, 4, 4) from being rigid motions, or ""."""
    is_none = np.isnan(T[:, :3]).all(axis=(1, 2))
    there = T[~is_none]
    if is_none.any() and not may_be_nan:
        return "a value is missing"
    rows = there[:, :3, :3]
    is_rigid = (np.abs(np.einsum("nij,nkj->nik", rows, rows) - np.eye(3)) < schema.NOT_RIGID).all(axis=(1, 2))
    is_rigid &= np.isfinite(there[:, :3, 3]).all(axis=1) & (there[:, 3] == np.eye(4)[3]).all(axis=1)
    return "" if is_rigid.all() else "not a rigid motion"


def _fits(n: int, symbol: str, bound: dict[str, int]) -> bool:
    """Compare one length with "2", "M" or "M+1", binding M where it is new."""
    if symbol.isdigit():
        return n == int(symbol)
    letter, _, plus = symbol.partition("+")
    return n >= int(plus or 0) and bound.setdefault(letter, n - int(plus or 0)) == n - int(plus or 0)


def save(value: Any, folder: Path) -> None:
    """Write each field as ``<folder>/<field>.npy``. Several types may share a folder: their field names differ."""
    check(value)
    for spec in fields(value):
        _save_field(type(value), spec, getattr(value, spec.name), folder)


def _save_field(cls: type, spec: Field, value: Any, folder: Path) -> None:
    column = np.asarray(value, order="C")
    if narrow := spec.metadata["narrow"]:
        column = column.astype(_narrowest(int(column.min(initial=0)), int(column.max(initial=0)), (*narrow, column.dtype)), copy=False)
    data = column.reshape(-1).view(np.uint8).data  # numpy's own way hides why a write fails
    files.write_new(_new_path(cls, spec, folder), memoryview(_header(column.shape, column.dtype)), data)


def _new_path(cls: type, spec: Field, folder: Path) -> Path:
    path = Path(folder) / f"{spec.name}.npy"
    if path.exists():
        raise ValueError(f"{cls.__name__}.{spec.name}: {path} is already written by another type")
    return path


def _header(shape: tuple[int, ...], dtype: np.dtype) -> bytes:
    """Return what precedes an array's bytes in its file; the number of rows does not change its length."""
    header = io.BytesIO()
    told = {"shape": shape, "fortran_order": False, "descr": np.lib.format.dtype_to_descr(dtype)}
    np.lib.format.write_array_header_1_0(header, told)
    return header.getvalue()


def _narrowest(least: int, most: int, dtypes: Sequence[np.dtype]) -> np.dtype:
    """Return the first of these whole-number types that holds what lies between two values; the last holds everything."""
    return next(dtype for dtype in dtypes if np.iinfo(dtype).min <= least and most <= np.iinfo(dtype).max)


class Writer(Generic[Record]):
    """Write a record of which some fields come a few rows at a time: the files are those that `save` would have written of the whole.

    with Writer(Matches, folder, "row") as writer:
        writer.append(row=rows)
        matches = writer.finish(pair=pair, offset=offset)
    """

    def __init__(self, cls: type[Record], folder: Path, *growing: str) -> None:
        """Begin the files of the fields `growing`, without rows."""
        self._cls, self._folder = cls, folder
        self._specs = {spec.name: spec for spec in fields(cls)}  # type: ignore[arg-type]  # mypy has no name for what is a dataclass
        self._growing: dict[str, _Growing] = {}
        with ExitStack() as opened:
            for name in growing:
                self._growing[name] = _Growing(_new_path(cls, self._specs[name], folder), self._specs[name])
                opened.callback(self._growing[name].close)
            self._open = opened.pop_all()

    def __enter__(self) -> "Writer[Record]":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._open.close()

    def append(self, **rows: np.ndarray) -> None:
        """Add rows (N, ...) to fields, each in the dtype declared."""
        for name, values in rows.items():
            self._growing[name].append(values)

    def finish(self, **values: Any) -> Record:
        """Write the other fields and return the record, mapped and to be read alone; SlamError, or ValueError, as `save` and `load`."""
        for name, value in values.items():
            _save_field(self._cls, self._specs[name], value, self._folder)
        for column in self._growing.values():
            column.finish()
        return adopted(load(self._cls, self._folder))


class _Growing:
    """The file of one field whose rows come a few at a time."""

    def __init__(self, path: Path, spec: Field) -> None:
        self._path, self._declared, self._narrow = path, spec.metadata["dtype"], spec.metadata["narrow"]
        self._tail = tuple(int(symbol) for symbol in spec.metadata["shape"][1:])
        self._n = self._least = self._most = 0
        self._dtype: np.dtype = (*self._narrow, self._declared)[0]
        with files.written(path):
            self._file = open(path, "x+b", buffering=files.AT_ONCE)  # noqa: SIM115 - closed by the writer that it belongs to
            self._file.write(_header((0, *self._tail), self._dtype))

    def append(self, rows: np.ndarray) -> None:
        if rows.dtype != self._declared or rows.shape[1:] != self._tail:
            raise ValueError(f"{self._path.name}: rows {rows.dtype} {rows.shape} are not {self._declared} (N, {self._tail})")
        if self._narrow:
            self._least, self._most = min(self._least, int(rows.min(initial=0))), max(self._most, int(rows.max(initial=0)))
            self._become(_narrowest(self._least, self._most, (*self._narrow, self._declared)))
        with files.written(self._path):
            self._file.write(np.ascontiguousarray(rows, dtype=self._dtype).reshape(-1).view(np.uint8).data)
        self._n += len(rows)

    def finish(self) -> None:
        with files.written(self._path):
            self._file.seek(0)
            self._file.write(_header((self._n, *self._tail), self._dtype))
            self._file.close()

    def close(self) -> None:
        """Close the file; what `finish` did not write is given up, and why has been said: a full disk would only say it again."""
        with suppress(OSError):
            self._file.close()

    def _become(self, dtype: np.dtype) -> None:
        """Write anew, in another type, what is there."""
        if dtype == self._dtype:
            return
        with files.written(self._path):
            self._file.flush()
            before = np.fromfile(self._path, dtype=self._dtype, offset=len(_header((0, *self._tail), self._dtype)))
            self._file.seek(0)
            self._file.truncate()
            self._file.write(_header((0, *self._tail), dtype))
            self._file.write(before.astype(dtype).view(np.uint8).data)
        self._dtype = dtype


def file_names(cls: type) -> list[str]:
    """List the files that `save` writes for a type."""
    return [f"{spec.name}.npy" for spec in fields(cls)]


def load(cls: type[Record], folder: Path, known: Mapping[str, int] | None = None) -> Record:
    """Read a record that `save` wrote; SlamError when a file is absent, torn, or not what `cls` declares.

    known : the `lengths` of the folder, where they are at hand
    Arrays are mapped, not read. The map is private and writable: kernels then see the same array type as for fresh arrays and are
    compiled once, while a write never reaches the file. Fields that are to be widened are read, where they were saved narrowly.
    """
    try:
        value = cls(**{spec.name: _load_field(spec, Path(folder)) for spec in fields(cls)})  # type: ignore[arg-type]  # mypy has no name for what is a dataclass
        check(value)
        known = lengths(folder) if known is None else known
        versions = [files.version(Path(folder) / name) for name in file_names(cls)]
        told = cls.__name__, *versions, *sorted(known.items())
        if told not in _sound:
            check_values(value, known)
            if all(map(files.is_settled, versions)):
                _remember(told)
    except ValueError as error:
        raise _refusal(folder, error) from error
    return value


def _refusal(folder: Path, error: ValueError) -> SlamError:
    return SlamError(f"{folder}: not what this version of slamcli writes ({error}); make it anew with: {hint().force()}")


def lengths(folder: Path, known: Mapping[str, int] = MappingProxyType({})) -> dict[str, int]:
    """Return what symbols stand for in the types that share a folder, as the files of `schema.LENGTHS` tell, added to what is known.

    known : what they stand for in another folder that is read with this one; SlamError where one differs
    """
    bound = dict(known)
    for name, symbol in schema.LENGTHS:
        path = Path(folder) / f"{name}.npy"
        n = _rows(path)
        if n is not None and not _fits(n, symbol, bound):
            raise SlamError(f"{path}: {n} rows do not fit {bound} of what is read with it; make it anew with: {hint().force()}")
    return bound


def _rows(path: Path) -> int | None:
    """Count the rows of an array; None where there is none. A file that nobody has written to since is not opened again."""
    version = files.version(path)
    if not version or version in _counted:
        return _counted.get(version)
    try:
        column = _read(path)
    except ValueError as error:
        raise _refusal(path.parent, error) from error
    n = len(column) if column.ndim else None
    if files.is_settled(version):
        if len(_counted) >= MOST_REMEMBERED:
            _counted.clear()
        _counted[version] = n
    return n


def _remember(told: tuple[Any, ...]) -> None:
    if len(_sound) >= MOST_REMEMBERED:
        _sound.clear()
    _sound.add(told)


def adopted(record: Record) -> Record:
    """Return a loaded record that is read alone: within a stage the memory of its arrays may be let go at any time."""
    for spec in fields(record):  # type: ignore[arg-type]  # mypy has no name for what is a dataclass
        mapped_memory.adopt(getattr(record, spec.name))
    return record


def _load_field(spec: Field, folder: Path) -> np.ndarray:
    column = _read(folder / f"{spec.name}.npy")
    if spec.metadata["widen"] and column.dtype in spec.metadata["narrow"]:
        return column.astype(spec.metadata["dtype"])
    return column


def _read(path: Path) -> np.ndarray:
    try:
        with np.errstate(over="raise"):  # of a size that no file has
            return np.asarray(np.lib.format.open_memmap(path, mode="c"))
    except FileNotFoundError:
        raise ValueError(f"{path.name} is not there") from None
    except (
        ValueError,
        EOFError,
        FloatingPointError,
        OverflowError,
        SyntaxError,
        TokenError,
        TypeError,
    ) as error:  # a map larger than its file is refused unread
        raise ValueError(f"{path.name}: {error}") from error
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({files.told(error)})") from error
