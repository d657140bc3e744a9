"""Images that lie in an SQLite file, read by their row; the file is never written to."""

import sqlite3
import threading
import weakref
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.datasets.images import check_whole
from slamcli.errors import BadFrame, SlamError

MAX_BLOB = 256 << 20  # bytes of one image
MADE_UP = (  # what is no table of stored values: reading it computes something, without end if the file was made so
    "SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'CREATE VIRTUAL%' "
    "OR (type = 'table' AND EXISTS (SELECT 1 FROM pragma_table_xinfo(sqlite_master.name) WHERE hidden > 1)) LIMIT 1"
)


def query(path: Path, text: str, *, what: str) -> list[tuple[Any, ...]]:
    """Run a query on a file opened for reading; SlamError where the file is not what it should be."""
    try:
        with closing(_connect(path)) as connection:
            return connection.execute(text).fetchall()
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise SlamError(f"{path}: is not {what}, or is damaged ({error})") from error


def check_stored(execute: Callable[[str], Any], path: Path) -> None:
    """Raise SlamError where a file holds views, generated columns or virtual tables; `execute` runs a query on it and returns its rows."""
    for (name,) in execute(MADE_UP):
        raise SlamError(f"{path}: {str(name)[:80]!r} is computed, not stored; no recorder writes that, so it is not read")


class Connections:
    """A connection to a file for each thread that asks; it is closed when the thread ends or this object goes."""

    def __init__(self, path: Path) -> None:
        self._path, self._local = path, threading.local()

    def of_this_thread(self) -> sqlite3.Connection:
        """Return the connection that belongs to the calling thread."""
        if not hasattr(self._local, "held"):
            self._local.held = _Held(_connect(self._path))
        return self._local.held.connection


class _Held:
    """A connection that is closed with its last owner: Python 3.13 warns of one that is only forgotten."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.connection = connection
        weakref.finalize(self, connection.close)


class Blobs:
    """Images of a column."""

    def __init__(
        self,
        path: Path,
        text: str,
        keys: Sequence[int],
        sizes: Sequence[int],
        label: str,
        decode: Callable[[bytes, str], bytes | np.ndarray] | None = None,
    ) -> None:
        self.path, self._text, self._keys, self._sizes, self._label, self._decode = path, text, keys, sizes, label, decode
        self._connections = Connections(path)

    @cached_property
    def names(self) -> list[str]:
        """Name images by key."""
        return [f"{self._label}#{key}" for key in self._keys]

    def where(self, i: int) -> str:
        """Name the file and the key."""
        return f"{self.path}:{self.names[i]}"

    def n_bytes(self, i: int) -> int:
        """Return the size of the blob."""
        return int(self._sizes[i])

    def read(self, i: int) -> bytes | np.ndarray:
        """Fetch and unpack one image."""
        if self._sizes[i] > MAX_BLOB:
            raise BadFrame(f"{self.where(i)}: {self._sizes[i] >> 20} MB is too large for an image")
        try:
            row = self._connections.of_this_thread().execute(self._text, (self._keys[i],)).fetchone()
        except sqlite3.Error as error:
            raise BadFrame(f"{self.where(i)}: cannot be read ({error})") from error
        data = bytes(row[0]) if row and row[0] is not None else b""
        check_whole(data, self.where(i))
        return self._decode(data, self.where(i)) if self._decode else data


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False)
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_BLOB)
        check_stored(connection.execute, path)
    except BaseException:
        connection.close()
        raise
    return connection
