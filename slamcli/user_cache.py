"""The user's cache folder: what lies there can be made again."""

import os
from pathlib import Path


def user_cache() -> Path:
    """Return the folder for compiled kernels, the demo's recording and downloads; it need not exist yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "slamcli"
