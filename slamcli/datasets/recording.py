"""A recording of colour and depth image files: what every reader returns and every stage uses."""

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamcli.datasets import images
from slamcli.geometry.camera import Camera
from slamcli.schema import Trajectory


@dataclass(frozen=True)
class Dataset:
    """F colour frames in the order of time, each with a depth image or without.

    Frames are decoded on demand; a file that cannot be used raises BadFrame then, so that one bad frame costs one frame.
    """

    reader: str  # name of the reader that recognised the folder
    name: str  # such as "tum/fr1_xyz"; runs/<name> is where a run goes
    root: Path
    camera: Camera
    stamp: np.ndarray  # (F,) float64, s, of the colour images, increasing
    depth_stamp: np.ndarray  # (F,) float64, s, NaN = no depth image
    colour_path: list[str]  # relative to root
    depth_path: list[str]  # relative to root, "" = none
    warnings: list[str] = field(default_factory=list)  # what reading the lists had to put right
    read_ground_truth: Callable[[], Trajectory | None] = lambda: None

    def __len__(self) -> int:
        return len(self.stamp)

    def grey(self, i: int) -> np.ndarray:
        """Decode frame i's grey image, (H, W) uint8."""
        return images.decode_grey(self.root / self.colour_path[i], self._size)

    def rgb(self, i: int) -> np.ndarray:
        """Decode frame i's colour image, (H, W, 3) uint8."""
        return images.decode_rgb(self.root / self.colour_path[i], self._size)

    def depth(self, i: int, camera: Camera | None = None) -> np.ndarray | None:
        """Decode frame i's depth, (H, W) float32 [m], NaN where there is no reading; None where the frame has no depth image.

        camera : what is known of the camera, where that is more than the recording's calibration
        """
        if not self.depth_path[i]:
            return None
        raw = images.decode_depth(self.root / self.depth_path[i], self._size)
        return images.metres(raw, (camera or self.camera).metres)

    def ground_truth(self) -> Trajectory | None:
        """Give the true camera-to-world poses, None where the recording has none."""
        return self.read_ground_truth()

    def digest(self) -> str:
        """Identify the recording by calibration and each frame's stamps, file names and sizes; contents are not read."""
        frames = [
            [repr(float(stamp)), repr(float(depth_stamp)), *names, *(_bytes(self.root, name) for name in names)]
            for stamp, depth_stamp, *names in zip(self.stamp, self.depth_stamp, self.colour_path, self.depth_path, strict=True)
        ]
        text = json.dumps([self.reader, self.camera.to_dict(), frames], sort_keys=True)
        return "sha256:" + hashlib.sha256(text.encode()).hexdigest()

    @property
    def _size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height


def _bytes(root: Path, name: str) -> int:
    """Size of a file, -1 where it is missing or not named."""
    try:
        return (root / name).stat().st_size if name else -1
    except OSError:
        return -1


def spread(n: int, wanted: int) -> Iterable[int]:
    """Give up to `wanted` indices below n, evenly spread."""
    return sorted({int(i) for i in np.linspace(0, n - 1, num=min(n, wanted))}) if n else []
