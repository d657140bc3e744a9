"""What images lie in a folder that no reader knows, so that its owner sees what is missing or called otherwise."""

import itertools
import os
from pathlib import Path

from slamcli.datasets.folder import IMAGE_SUFFIXES

MOST_FOLDERS = 12  # that are looked into, by name
MOST_FILES = 10_000  # of a folder that are counted
PNG, BITS_AT = b"\x89PNG\r\n\x1a\n", 24  # of a PNG: how it begins, and where its header says the bits of a channel
DEPTH_BITS = 16
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi")


def describe(path: Path) -> str:
    """Say what images a folder and those directly in it hold, and what is to be done with them; "" where there are none.

    Of each folder one image is looked at: 16 bits a channel are depth, all else is colour.
    """
    inner = sorted(entry for entry in path.iterdir() if entry.is_dir())[:MOST_FOLDERS]
    found = [(folder, *_images(folder)) for folder in (path, *inner)]
    told = {
        is_depth: [_told(folder, path, n, is_depth) for folder, n, deep in found if n and deep == is_depth] for is_depth in (False, True)
    }
    if not told[False] and not told[True]:
        return ""
    if not told[True]:
        return f"{', '.join(told[False])}, no depth images (PNG of {DEPTH_BITS} bits)"
    if not told[False]:
        video = next((entry.name for entry in sorted(path.iterdir()) if entry.suffix.lower() in VIDEO_SUFFIXES), "")
        unpack = f" but the video {video}: write its pictures into rgb/, as ffmpeg does" if video else ""
        return f"{', '.join(told[True])}, no colour images{unpack}"
    return f"{', '.join(told[False] + told[True])}: name the folders rgb and depth, or list the pairs in associations.txt"


def _images(folder: Path) -> tuple[int, bool]:
    """Count the images of a folder, and say whether the first by name is of depth."""
    try:
        with os.scandir(folder) as entries:
            names = sorted(
                entry.name for entry in itertools.islice(entries, MOST_FILES) if Path(entry.name).suffix.lower() in IMAGE_SUFFIXES
            )
        return len(names), bool(names) and _is_depth(folder / names[0])
    except OSError:  # what cannot be read was not seen
        return 0, False


def _is_depth(path: Path) -> bool:
    if not path.is_file():  # a pipe would keep whoever opens it waiting
        return False
    with path.open("rb") as file:
        head = file.read(BITS_AT + 1)
    return head.startswith(PNG) and head[BITS_AT:] == bytes([DEPTH_BITS])


def _told(folder: Path, root: Path, n: int, is_depth: bool) -> str:
    count = f"{n} or more" if n == MOST_FILES else str(n)
    where = "it" if folder == root else f"{folder.name}/"
    return f"{count} {'16-bit' if is_depth else 'colour'} image{'s' if n > 1 else ''} in {where}"
