"""The demo recording: rendered once, then kept in the user's cache."""

from collections.abc import Callable, Iterable
from pathlib import Path

from slamcli.datasets.simulate import simulate

VERSION = 4  # raised whenever the simulated images change: an older cached demo is then no longer used
SEED = 7
FRAMES = 320

Progress = Callable[..., Iterable]


def demo_folder(cache: Path, *, progress: Progress) -> Path:
    """Return the folder of the demo recording, rendering it first where it is missing."""
    folder = cache / f"demo-{VERSION}"
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        try:
            simulate(folder, seed=SEED, frames=FRAMES, progress=progress)
        except OSError:
            if not folder.is_dir():  # else another process was faster, with the same bytes
                raise
    return folder
