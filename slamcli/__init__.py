"""Indoor mapping from a colour-and-depth camera: trajectory, cloud, octree and navigation grid."""

import hashlib
import os
from pathlib import Path

__version__ = "0.1.0"


def user_cache() -> Path:
    """Name the folder for what can be made again: compiled kernels, the demo's recording, downloads."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "slamcli"


def _kernel_cache() -> str:
    """Choose where numba keeps compiled kernels.

    numba recompiles a kernel when its own file changes but does not notice a change in a helper of another file. Kernels share
    helpers only through `geometry/`, and numba's settings through `jit/kernel.py`, so a folder per state of these makes stale machine
    code impossible.
    """
    digest, package = hashlib.sha256(), Path(__file__).parent
    for source in (package / "jit" / "kernel.py", *sorted((package / "geometry").glob("*.py"))):
        digest.update(source.read_bytes())
    folder = user_cache() / f"kernels-{digest.hexdigest()[:12]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return str(folder)
    except OSError:
        pass
    return _passing_cache()


def _passing_cache() -> str:
    """Make a folder for this process alone: without any writable one numba refuses to import a cached kernel at all."""
    import atexit
    import shutil
    import tempfile

    folder = tempfile.mkdtemp(prefix="slamcli-kernels-")  # private: a cache that others can write to is code from others
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


if "NUMBA_CACHE_DIR" not in os.environ:  # numba reads it when first imported
    os.environ["NUMBA_CACHE_DIR"] = _kernel_cache()
