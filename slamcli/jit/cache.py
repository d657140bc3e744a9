"""Where compiled kernels are kept: a folder of our own, told to each of our kernels and to nobody else's.

numba's own setting, $NUMBA_CACHE_DIR, holds for every kernel of a process, those of a notebook that imports slamcli among them.
"""

import atexit
import functools
import hashlib
import os
import pickle
import shutil
import tempfile
from pathlib import Path
from typing import Any

from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, _CacheLocator

from slamcli.user_cache import user_cache

PACKAGE = Path(__file__).parents[1]
UNSAVED: list[OSError] = []  # why kernels of this process could not be kept


@functools.cache
def folder() -> Path:
    """Choose the folder of compiled kernels once for this process: in $NUMBA_CACHE_DIR if that is set, else in the user's cache.

    numba compiles a kernel anew when its own file changes but does not notice a change in a helper of another file. Kernels share
    helpers only through `geometry/`, and numba's settings through `jit/kernel.py`, so a folder per state of these makes stale machine
    code impossible.
    """
    digest = hashlib.sha256()
    for source in (PACKAGE / "jit" / "kernel.py", *sorted((PACKAGE / "geometry").glob("*.py"))):
        digest.update(source.read_bytes())
    given = os.environ.get("NUMBA_CACHE_DIR")
    place = Path(given).absolute() if given else user_cache()
    return (place if _is_writable(place) else _temporary()) / f"kernels-{digest.hexdigest()[:12]}"


def _is_writable(place: Path) -> bool:
    """Say whether a folder, or the nearest one above it that exists, can be written to; nothing is made for it."""
    while not place.exists() and place != place.parent:
        place = place.parent
    return place.is_dir() and os.access(place, os.W_OK | os.X_OK)


def _temporary() -> Path:
    """Make a folder for this process alone, so that the processes that compile for it have a place to leave their kernels."""
    place = tempfile.mkdtemp(prefix="slamcli-kernels-")  # private: a cache that others can write to is code from others
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return Path(place)


class KernelLocator(_CacheLocator):
    """Tell numba where a kernel's machine code is kept, and of which source it is."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file = py_file
        self._line = py_func.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "KernelLocator":
        """Build the locator of a function."""
        return cls(py_func, py_file)

    def get_cache_path(self) -> str:
        """Name the folder; each folder of sources has its own, so that two copies of this package do not mix their kernels."""
        return os.path.join(folder(), self.get_suitable_cache_subpath(self._py_file))

    def get_source_stamp(self) -> str:
        """Digest the kernel's file."""
        return _digest(self._py_file)

    def get_disambiguator(self) -> str:
        """Tell kernels of equal names in one file apart."""
        return str(self._line)


@functools.cache
def _digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class _KernelCacheImpl(CompileResultCacheImpl):
    _locator_classes = [KernelLocator]  # noqa: RUF012  # numba's own declaration


class _Kept(IndexDataCacheFile):
    """The files of one kernel. What cannot be read, as it names a record that is called otherwise now or is torn, counts as not there."""

    _UNREADABLE = (AttributeError, ImportError, EOFError, ValueError, pickle.UnpicklingError)

    def load(self, key: Any) -> Any:
        """Read machine code; None where there is none."""
        try:
            return super().load(key)
        except self._UNREADABLE:
            return None

    def _load_index(self) -> dict:
        try:
            return super()._load_index()
        except self._UNREADABLE:
            return {}


class KernelCache(FunctionCache):
    """The machine code of one kernel, by the types of its arguments and, of records, the names of their fields."""

    _impl_class = _KernelCacheImpl

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        self._cache_file = _Kept(self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp())

    def _index_key(self, sig: Any, codegen: Any) -> tuple:
        """Tell records apart whose fields changed places: they come from any file, and to numba they are their types in order."""
        fields = tuple(of.fields for of in getattr(sig, "args", sig) if isinstance(of, types.BaseNamedTuple))
        return (*super()._index_key(sig, codegen), fields)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save machine code. A folder that is full or not to be written to costs time in the next process, and nothing now."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            UNSAVED.append(error)
