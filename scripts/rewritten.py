"""Recordings made from another one by rewriting its lists: frames blacked out, cut out, or played again and again.

The images stay where they are; the new folder links to them. Stamps are those of the source unless said otherwise.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from slamcli.datasets import Dataset, open_dataset
from slamcli.datasets.lists import read_list
from slamcli.formats.trajectory import write_tum
from slamcli.schema import Trajectory


@dataclass(frozen=True)
class Listed:
    """What the lists of a recording say."""

    source: Dataset
    colour: list[tuple[float, str]]  # stamp [s] and file of each image
    depth: list[tuple[float, str]]
    truth: Trajectory | None

    @property
    def start(self) -> float:
        """Return the stamp of the first colour image [s]."""
        return self.colour[0][0]


def listed(source: str | Path) -> Listed:
    """Read the lists of a recording in the TUM layout."""
    dataset = open_dataset(str(source))
    colour, depth = (read_list(dataset.root / f"{name}.txt") for name in ("rgb", "depth"))
    pairs = (list(zip(found.stamp.tolist(), found.names, strict=True)) for found in (colour, depth))
    return Listed(dataset, *pairs, dataset.ground_truth())


def write(folder: Path, lists: Listed) -> Path:
    """Write a recording that says what `lists` say; a folder that is there already is kept as it is."""
    if folder.exists():
        return folder
    folder.mkdir(parents=True)
    black = {name for _, name in (*lists.colour, *lists.depth) if "/" not in name}
    size = (lists.source.camera.height, lists.source.camera.width)
    for name in black:
        cv2.imwrite(str(folder / name), np.zeros(size, dtype=np.uint16 if name == "no_depth.png" else np.uint8))
    for name in sorted({Path(name).parts[0] for _, name in (*lists.colour, *lists.depth)} - black):
        (folder / name).symlink_to((lists.source.root / name).resolve())
    for name, entries in (("rgb", lists.colour), ("depth", lists.depth)):
        (folder / f"{name}.txt").write_text("".join(f"{stamp:.6f} {file}\n" for stamp, file in entries))
    (folder / "camera.json").write_text(json.dumps(lists.source.camera.to_dict(), indent=1) + "\n")
    if lists.truth is not None:
        write_tum(folder / "groundtruth.txt", lists.truth)
    return folder


def thinned(lists: Listed, offset: int, every: int) -> Listed:
    """Leave out the first colour frames, and of the others all but every n-th."""
    return replace(lists, colour=lists.colour[offset::every])


def between(lists: Listed, start: float, stop: float) -> Listed:
    """Keep what lies between two times [s after the first colour image]."""
    return _kept(lists, lambda seconds: start <= seconds < stop)


def without(lists: Listed, start: float, stop: float) -> Listed:
    """Leave out what lies between two times [s after the first colour image]."""
    return _kept(lists, lambda seconds: not start <= seconds < stop)


def _kept(lists: Listed, is_wanted) -> Listed:
    colour, depth = ([entry for entry in entries if is_wanted(entry[0] - lists.start)] for entries in (lists.colour, lists.depth))
    return replace(lists, colour=colour, depth=depth)


def blackout(lists: Listed, first: int, frames: int) -> Listed:
    """Cover the lens for some colour frames: their images, and depth images of that time, are black."""
    start, stop = (lists.colour[i][0] for i in (first, first + frames - 1))
    colour = [(stamp, "black.png" if start <= stamp <= stop else name) for stamp, name in lists.colour]
    depth = [(stamp, "no_depth.png" if start <= stamp <= stop else name) for stamp, name in lists.depth]
    return replace(lists, colour=colour, depth=depth)


def again(lists: Listed, frames: int, *, turning: bool = True) -> Listed:
    """Play again and again until there are so many colour frames, every other time backward if `turning`; stamps go on at the same pace."""
    length = lists.colour[-1][0] - lists.start
    period = length + (lists.colour[1][0] - lists.start)
    n_turns = -(-frames // len(lists.colour))

    def shifted(stamp: float, turn: int) -> float:
        seconds = stamp - lists.start
        return lists.start + turn * period + (length - seconds if turning and turn % 2 else seconds)

    colour, depth = (
        sorted((shifted(stamp, turn), name) for turn in range(n_turns) for stamp, name in entries)
        for entries in (lists.colour, lists.depth)
    )
    colour = colour[:frames]
    truth = lists.truth
    if truth is not None:
        during = (truth.stamp >= lists.start) & (truth.stamp <= lists.colour[-1][0])
        stamp = np.concatenate([[shifted(s, turn) for s in truth.stamp[during]] for turn in range(n_turns)])
        order = np.unique(stamp, return_index=True)[1]
        truth = Trajectory(stamp=stamp[order], T_wc=np.concatenate([truth.T_wc[during]] * n_turns)[order])
    return replace(lists, colour=colour, depth=[entry for entry in depth if entry[0] <= colour[-1][0] + 0.02], truth=truth)
