"""Records of arrays as folders of `.npy`, one file a field. A record's type is its schema; it is checked at every save and load."""

import io
import mmap
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from tokenize import TokenError
from typing import Any, TypeVar

import numpy as np

from slamcli import files
from slamcli.errors import SlamError

Record = TypeVar("Record")


def check(value: Any) -> None:
    """Compare each field's dtype and shape with its declaration; ValueError names the field at fault.

    A symbol such as "M" stands for the same length in every field of the type; the first field that has it alone binds it.
    """
    bound: dict[str, int] = {}
    for spec in fields(value):
        column = np.asarray(getattr(value, spec.name))
        name, dtype, shape = f"{type(value).__name__}.{spec.name}", spec.metadata["dtype"], spec.metadata["shape"]
        if column.dtype not in (dtype, *spec.metadata["narrow"]):
            raise ValueError(f"{name}: dtype {column.dtype} is not {dtype}")
        if len(column.shape) != len(shape) or not all(_fits(n, symbol, bound) for n, symbol in zip(column.shape, shape, strict=True)):
            raise ValueError(f"{name}: shape {column.shape} does not fit {list(shape)} with {bound}")


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
        path = Path(folder) / f"{spec.name}.npy"
        if path.exists():
            raise ValueError(f"{type(value).__name__}.{spec.name}: {path} is already written by another type")
        column = _narrowest(np.asarray(getattr(value, spec.name), order="C"), spec.metadata["narrow"])
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(column))
        data = column.reshape(-1).view(np.uint8).data  # numpy's own way hides why a write fails
        files.write_new(path, memoryview(header.getvalue()), data)


def _narrowest(column: np.ndarray, narrow: Sequence[np.dtype]) -> np.ndarray:
    """Return a column in the first of these whole-number types that holds all its values, as it is where none does."""
    least, most = int(column.min(initial=0)) if narrow else 0, int(column.max(initial=0)) if narrow else 0
    for dtype in narrow:
        if np.iinfo(dtype).min <= least and most <= np.iinfo(dtype).max:
            return column.astype(dtype)
    return column


def file_names(cls: type) -> list[str]:
    """List the files that `save` writes for a type."""
    return [f"{spec.name}.npy" for spec in fields(cls)]


def load(cls: type[Record], folder: Path) -> Record:
    """Read a record that `save` wrote; SlamError when a file is absent, torn, or not what `cls` declares.

    Arrays are mapped, not read. The map is private and writable: kernels then see the same array type as for fresh arrays and are
    compiled once, while a write never reaches the file.
    """
    try:
        value = cls(**{spec.name: _read(Path(folder) / f"{spec.name}.npy") for spec in fields(cls)})  # type: ignore[arg-type]
        check(value)
    except ValueError as error:
        raise SlamError(f"{folder}: not what this version of slamcli writes ({error}); make it anew with: slamcli run --force") from error
    return value


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


def release(value: Any) -> None:
    """Let go of the memory that the mapped fields of a record hold so far; what is read again comes from the file.

    For fields that are read alone: what was written to one would be forgotten. Other threads may read them meanwhile.
    """
    for spec in fields(value):
        if (mapped := _map_of(getattr(value, spec.name))) is not None:
            mapped.madvise(mmap.MADV_DONTNEED)


def _map_of(column: np.ndarray) -> mmap.mmap | None:
    """Return the map that an array is a view of, None where it is of no file or where the system takes no advice."""
    base: Any = column
    while isinstance(base, np.ndarray):
        base = base.base
    return base if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED") else None
