"""What is in a recording's folder, and which of its files a list means."""

import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from slamcli.errors import SlamError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".webp")
DEPTH_SUFFIXES = (*IMAGE_SUFFIXES, ".exr", ".npy", ".pfm")
COLOUR_FOLDERS = ("rgb", "color", "colour", "image", "images", "colors", "rgbs", "cam0", "left")
MOST_DIGITS = 18  # of a number in a name: what 64 bits hold
DEPTH_FOLDERS = ("depth", "depths", "depth_registered", "aligned_depth", "depth_aligned", "depth_images")


class Folder:
    """A folder whose listings are read once."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._listed: dict[str, dict[str, str]] = {}
        self._stems: dict[str, dict[str, str]] = {}

    def files(self, below: str = "") -> list[str]:
        """List the files directly in a folder below the root, names only, sorted."""
        return sorted(set(self._names(below).values()))

    def find(self, listed: str, homes: tuple[str, ...] = ()) -> str:
        """Return the file that a list means, relative to the root; the name as listed (tidied) where there is none.

        Backslashes, another case, another suffix and paths of the machine that wrote the list are seen through; what leads out of the
        folder is refused with SlamError. `homes` are folders to look in where a bare name is not in the root.
        """
        listed = listed.strip().strip("\"'").removeprefix("file://")
        name = listed.replace("\\", "/")
        windows, posix = PureWindowsPath(listed), PurePosixPath(name)
        if ".." in posix.parts:
            raise SlamError(f"{listed!r} leads out of the recording's folder")
        if posix.is_absolute() or windows.is_absolute() or windows.drive:
            found = self._tail(posix)
            if found is None:
                raise SlamError(f"{listed!r} leads out of the recording's folder")
            return found
        found = self._exact(posix)
        if found is None and len(posix.parts) == 1:
            found = next((there for home in homes if (there := self._exact(PurePosixPath(home) / posix)) is not None), None)
        return found or str(posix)

    def has(self, name: str) -> bool:
        """Say whether a listed name is a file that is there, in any spelling that `find` sees through."""
        return self._exact(PurePosixPath(name.replace("\\", "/"))) is not None

    def _tail(self, path: PurePosixPath) -> str | None:
        """Find a path of another place by its end, the longest that exists here."""
        parts = [part for part in path.parts if part != "/" and not part.endswith(":")]
        for start in range(len(parts)):
            found = self._exact(PurePosixPath(*parts[start:]))
            if found is not None:
                return found
        return None

    def _exact(self, path: PurePosixPath) -> str | None:
        folder = "" if str(path.parent) == "." else self._as_spelt(str(path.parent))
        names = self._names(folder)
        found = names.get(path.name) or names.get(path.name.lower())
        if found is None:
            found = self._stem_table(folder).get(path.stem.lower() if path.suffix.lower() in DEPTH_SUFFIXES else path.name.lower())
        return str(PurePosixPath(folder, found)) if found is not None else None

    def _names(self, folder: str) -> dict[str, str]:
        """Return the files of a folder by their name and by its lower case."""
        if folder not in self._listed:
            try:
                with os.scandir(self.root / folder) as entries:
                    names = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_file()]
            except (OSError, ValueError):
                names = []
            self._listed[folder] = {name.lower(): name for name in names} | {name: name for name in names}
        return self._listed[folder]

    def _as_spelt(self, folder: str) -> str:
        """Return the folder's name as the file system spells it; unchanged where it is there, or not there in any spelling."""
        try:
            is_there = not folder or (self.root / folder).is_dir()
        except (OSError, ValueError):  # a name that no folder can have
            is_there = True
        if is_there:
            return folder
        return subfolder(self.root, (folder.lower(),)) or folder

    def _stem_table(self, folder: str) -> dict[str, str]:
        """Return the images of a folder by their name without suffix."""
        if folder not in self._stems:
            names = sorted(set(self._names(folder).values()), reverse=True)
            self._stems[folder] = {Path(n).stem.lower(): n for n in names if Path(n).suffix.lower() in DEPTH_SUFFIXES}
        return self._stems[folder]


def subfolder(root: Path, names: tuple[str, ...]) -> str | None:
    """Return the first of these folders that is there, whatever its case."""
    try:
        there = {entry.name.lower(): entry.name for entry in os.scandir(root) if entry.is_dir()}
    except OSError:
        return None
    return next((there[name] for name in names if name in there), None)


def number_of(name: str) -> int | None:
    """Return the last number in a file's name without its suffix, such as 12 of "frame-000012.color.jpg"; None where it has none."""
    found = re.findall(r"\d+", PurePosixPath(name).name.split(".")[0]) or re.findall(r"\d+", PurePosixPath(name).stem)
    return int(found[-1][-MOST_DIGITS:]) if found else None


def in_step(numbers: Sequence[int], others: dict[int, str], where: Path) -> tuple[dict[int, str], list[str]]:
    """Return the images of a second stream by the numbers of the first, and what is to be said of it.

    Where both count without a gap and end after as many images, but one from 0 on and the other from 1, say, they belong together in order.
    """
    theirs = sorted(others)
    shift = theirs[0] - numbers[0] if theirs and numbers else 0
    if shift == 0 or theirs != [number + shift for number in numbers] or theirs != list(range(theirs[0], theirs[0] + len(theirs))):
        return others, []
    said = f"{where}: depth images are numbered from {theirs[0]} on, colour from {numbers[0]}; paired in their order"
    return {number - shift: name for number, name in others.items()}, [said]


def numbered(folder: Folder, below: str, suffixes: tuple[str, ...], *, ending: str = "") -> dict[int, str]:
    """List the images of a folder by the number in their name; `ending` is what the name ends with before its suffix.

    Names that are decimal numbers (time stamps) have no number of this kind.
    """
    found: dict[int, str] = {}
    for name in folder.files(below):
        path = PurePosixPath(name)
        if path.suffix.lower() in suffixes and path.stem.endswith(ending):
            number = number_of(path.stem.removesuffix(ending))
            if number is not None:
                found.setdefault(number, str(PurePosixPath(below, name)))
    return dict(sorted(found.items()))
