"""Vocabulary files: a NumPy archive (.npz) of the tree's arrays, read with every size checked before memory is reserved."""

import zipfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.hints import hint
from slamcli.vision.vocabulary import MAX_NODES, Vocabulary, check

FORMAT = 1
SHIPPED = Path(__file__).resolve().parent.parent / "data" / "vocabulary.npz"
_FILE_ARRAYS = {"format": ("i4", 0), "centre": ("u1", 2), "first_child": ("i4", 1), "idf": ("f4", 1), "origin": ("u1", 1)}


def write(path: str | Path, vocabulary: Vocabulary) -> None:
    """Write a vocabulary file (.npz)."""
    origin = np.frombuffer(vocabulary.origin.encode(), dtype=np.uint8)
    with files.whole(path) as file:
        np.savez(
            file, format=np.int32(FORMAT), centre=vocabulary.centre, first_child=vocabulary.first_child, idf=vocabulary.idf, origin=origin
        )


def read(path: str | Path = "") -> Vocabulary:
    """Read a vocabulary file, the shipped one without a path; SlamError names the file and its fault."""
    path = Path(path) if str(path) else SHIPPED
    try:
        found = path.stat()
    except OSError as error:
        raise SlamError(f"{path}: the vocabulary cannot be read ({error.strerror}); make one with: {hint().train_vocabulary()}") from error
    return _read(path, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=2)
def _read(path: Path, _mtime_ns: int, _size: int) -> Vocabulary:
    """Read the file, once as long as it stays the same."""
    try:
        columns = _read_arrays(path)
    except OSError as error:
        raise SlamError(
            f"{path}: the vocabulary cannot be read ({error.strerror or error}); make one with: {hint().train_vocabulary()}"
        ) from error
    except SlamError:
        raise
    except Exception as error:  # what zipfile, its decompressors and numpy's header raise is not declared anywhere
        raise SlamError(
            f"{path}: not a vocabulary of slamcli ({error}); text files of DBoW2 come in by: {hint().import_vocabulary()}"
        ) from error
    vocabulary = Vocabulary(columns["centre"], columns["first_child"], columns["idf"], columns["origin"].tobytes().decode(errors="replace"))
    try:
        return check(vocabulary, source=str(path))
    except SlamError as error:
        raise SlamError(f"{error}; make one with: {hint().train_vocabulary()}") from error


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of the file, each checked for type and size before memory is reserved."""
    columns = {}
    with files.open_regular(path) as file, zipfile.ZipFile(file) as archive:
        for name, (dtype, n_axes) in _FILE_ARRAYS.items():
            try:
                member = archive.open(name + ".npy")
            except KeyError:
                raise ValueError(f"{name} is missing") from None
            with member:
                version = np.lib.format.read_magic(member)
                if version != (1, 0):
                    raise ValueError(f"{name} is of an unknown kind")
                shape, fortran_order, kind = np.lib.format.read_array_header_1_0(member)
                row_bytes = 32 if name == "centre" else 1
                if kind != np.dtype(dtype) or len(shape) != n_axes or fortran_order or (n_axes == 2 and shape[1] != row_bytes):
                    raise ValueError(f"{name} has type {kind} and shape {shape}")
                if n_axes and not 0 <= shape[0] <= MAX_NODES + 1:
                    raise ValueError(f"{name} has {shape[0]} rows")
                n_bytes = int(np.prod(shape)) * kind.itemsize
                content = member.read(n_bytes + 1)
                if len(content) != n_bytes:
                    raise ValueError(f"{name} is cut short")
                columns[name] = np.frombuffer(bytearray(content), dtype=kind).reshape(shape)
    if columns["format"] != FORMAT:
        raise ValueError(f"format {int(columns['format'])}, this version reads {FORMAT}")
    return columns
