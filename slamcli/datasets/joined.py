"""Several recordings as one: frames are numbered through, and all pictures are told in the pixels of one camera."""

import hashlib
import json
import os
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from slamcli.datasets.protocol import Dataset
from slamcli.errors import SlamError
from slamcli.geometry.camera import Camera
from slamcli.geometry.common_camera import Retelling, common_camera
from slamcli.schema import Recordings, Trajectory

READER = "joined"  # begins the name of the layout; those of the recordings follow
APART = 100.0  # [s] at least between two recordings on the common time line: more than any stage looks ahead or back
MARGIN = 1.0  # [s] around a recording, beyond which its true poses are left out
SHOWN = 3  # names of recordings in the name of several


def in_order(datasets: Sequence[Dataset]) -> list[int]:
    """Return the order in which recordings are joined, whatever the order in which they were named.

    By their clocks where no two overlap; else clocks do not tell which came first, and names do, numbers in them by value.
    """
    spans = sorted((float(dataset.stamp[0]), float(dataset.stamp[-1])) for dataset in datasets)
    do_clocks_tell = all(before[1] < after[0] for before, after in zip(spans, spans[1:], strict=False))

    def key(i: int) -> tuple:
        name = [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", datasets[i].name)]
        return float(datasets[i].stamp[0]) if do_clocks_tell else 0.0, name, datasets[i].digest()

    return sorted(range(len(datasets)), key=key)


def unique_names(wanted: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """Name recordings for folders and options, each differently: the last part of its name, and a number where that is taken."""
    names = list(taken)
    for whole in wanted:
        name = base = whole.rpartition("/")[2]
        number = 2
        while name in names:
            name, number = f"{base}-{number}", number + 1
        names.append(name)
    return names[len(taken) :]


class JoinedDataset:
    """Recordings of one place one after the other, in one camera's pixels and on one time line; meets protocol.Dataset."""

    def __init__(self, parts: Sequence[Dataset], names: Sequence[str]) -> None:
        """Take the recordings in their order, each with a name of its own.

        Each keeps its stamps where it begins after the one before; else its whole time line is moved behind that, by whole seconds.
        """
        self.parts, self.names = list(parts), list(names)
        self.offset = np.cumsum([0] + [len(part) for part in parts], dtype=np.int64)
        self.camera = common_camera([part.camera for part in parts])
        self._retellings = [Retelling(part.camera, self.camera) for part in parts]
        self._shift = _shifts(parts)
        self.stamp = np.concatenate([part.stamp + shift for part, shift in zip(parts, self._shift, strict=True)])
        self.depth_stamp = np.concatenate([part.depth_stamp + shift for part, shift in zip(parts, self._shift, strict=True)])

    def __len__(self) -> int:
        return int(self.offset[-1])

    @property
    def reader(self) -> str:
        """Name the layouts."""
        return "+".join([READER, *sorted({part.reader for part in self.parts})])

    @property
    def name(self) -> str:
        """Name the recordings."""
        more = len(self.names) - SHOWN
        return " + ".join(self.names[:SHOWN]) + (f" and {more} more" if more > 0 else "")

    @property
    def root(self) -> Path:
        """Name the folder that all recordings lie in."""
        return Path(os.path.commonpath([part.root.resolve() for part in self.parts]))

    @property
    def depth_camera(self) -> Camera | None:
        """Return nothing: depth is delivered in the common camera's pixels."""
        return None

    @property
    def warnings(self) -> list[str]:
        """List what opening the recordings had to put right or to assume."""
        told = [warning for part in self.parts for warning in part.warnings]
        other = [name for name, how in zip(self.names, self._retellings, strict=True) if not how.is_identity]
        if other:
            size = f"{self.camera.width} x {self.camera.height}"
            told.append(f"cameras differ: the pictures of {', '.join(other)} are told in the pixels of one camera of {size} px")
        return told

    @cached_property
    def colour_name(self) -> Sequence[str]:
        """Name each colour image within its recording, after the recording's name."""
        return [f"{name}/{image}" for part, name in zip(self.parts, self.names, strict=True) for image in part.colour_name]

    @cached_property
    def depth_name(self) -> Sequence[str]:
        """Name each depth image likewise, "" = none."""
        return [f"{name}/{image}" if image else "" for part, name in zip(self.parts, self.names, strict=True) for image in part.depth_name]

    def recordings(self) -> Recordings:
        """Return which frames are of which recording."""
        return Recordings(recording_offset=self.offset, own_stamp=np.concatenate([np.asarray(part.stamp) for part in self.parts]))

    def retelling(self, recording: int) -> Retelling:
        """Return how a recording's measurements are told in the common camera's pixels."""
        return self._retellings[recording]

    def place(self, i: int) -> tuple[int, int]:
        """Return the recording of frame i, and the frame's number there."""
        recording = int(np.searchsorted(self.offset, i, side="right")) - 1
        return recording, i - int(self.offset[recording])

    def grey(self, i: int) -> np.ndarray:
        """Decode frame i's grey image, (H, W) uint8."""
        recording, frame = self.place(i)
        return self._picture(recording, self.parts[recording].grey(frame))

    def rgb(self, i: int) -> np.ndarray:
        """Decode frame i's colour image, (H, W, 3) uint8, red first; black where its camera saw nothing."""
        recording, frame = self.place(i)
        return self._picture(recording, self.parts[recording].rgb(frame))

    def depth(self, i: int, camera: Camera | None = None) -> np.ndarray | None:
        """Decode frame i's depth, (H, W) float32 [m], NaN where there is no reading; None where the frame has no depth image.

        camera : the common one, of which no more is known than the recordings' calibrations say
        """
        recording, frame = self.place(i)
        depth = self.parts[recording].depth(frame)
        return None if depth is None else self._retellings[recording].depth(depth)

    def mask(self, i: int) -> np.ndarray | None:
        """Decode frame i's mask, (H, W) bool, true where the picture must not be used; None where the frame has none."""
        recording, frame = self.place(i)
        mask = self.parts[recording].mask(frame)
        return None if mask is None else self._picture(recording, mask.astype(np.uint8), nearest=True) > 0

    def _picture(self, recording: int, picture: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        how = self._retellings[recording]
        if how.is_identity:
            return picture
        u, v = cv2.split(how.source)
        return cv2.remap(picture, u, v, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR)

    def ground_truth(self) -> Trajectory | None:
        """Return the true poses of the recordings that have any, on the common time line; they must be told in one frame for all."""
        found = [self._truth(k) for k in range(len(self.parts))]
        known = [truth for truth in found if truth is not None]
        if not known:
            return None
        return Trajectory(stamp=np.concatenate([t.stamp for t in known]), T_wc=np.concatenate([t.T_wc for t in known]))

    def _truth(self, recording: int) -> Trajectory | None:
        part = self.parts[recording]
        truth = part.ground_truth()
        if truth is None:
            return None
        here = (truth.stamp >= part.stamp[0] - MARGIN) & (truth.stamp <= part.stamp[-1] + MARGIN)
        return Trajectory(stamp=truth.stamp[here] + self._shift[recording], T_wc=truth.T_wc[here])

    def digest(self) -> str:
        """Identify the recordings, in their order."""
        content = [READER, [part.digest() for part in self.parts]]
        return "sha256:" + hashlib.sha256(json.dumps(content).encode()).hexdigest()


def check_different(datasets: Sequence[Dataset]) -> None:
    """Raise SlamError where a recording is named twice: every place in it would be seen again."""
    seen: dict[str, Dataset] = {}
    for dataset in datasets:
        digest = dataset.digest()
        if digest in seen:
            raise SlamError(f"{dataset.root}: the same recording as {seen[digest].root}; name each once")
        seen[digest] = dataset


def _shifts(parts: Sequence[Dataset]) -> list[float]:
    """Return what is added to each recording's stamps [s]."""
    shifts: list[float] = []
    last = -np.inf
    for part in parts:
        first = float(part.stamp[0])
        shift = 0.0 if first > last + APART else float(np.ceil(last + APART - first))
        shifts.append(shift)
        last = float(part.stamp[-1]) + shift
    return shifts
