"""A recording as all readers return it: colour and depth images by row, decoded on demand."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from slamcli.datasets import images
from slamcli.datasets.sources import Images, depth_pixels, picture
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_registration import Registration, resized
from slamcli.schema import Trajectory


@dataclass(frozen=True)
class Recording:
    """F colour frames in the order of time; meets protocol.Dataset."""

    reader: str  # name of the layout
    name: str  # such as "tum/fr1_xyz"
    root: Path
    camera: Camera  # of the pictures as delivered, reduced or not
    stamp: np.ndarray  # (F,) float64, s, of the colour images, increasing
    depth_stamp: np.ndarray  # (F,) float64, s, NaN = no depth image
    colour: Images
    colour_row: np.ndarray  # (F,) int64 into `colour`
    depth_images: Images
    depth_row: np.ndarray  # (F,) int64 into `depth_images`, -1 = none
    size: tuple[int, int]  # (width, height) of colour as recorded
    depth_size: tuple[int, int] | None  # of depth as recorded, None = no depth image could be read
    reduction: int = 1  # pictures are delivered this many times smaller
    registration: Registration | None = None  # where depth is of another camera
    masks: Images | None = None  # by colour row
    warnings: list[str] = field(default_factory=list)  # what opening had to put right or to assume
    read_ground_truth: Callable[[], Trajectory | None] = lambda: None

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def depth_camera(self) -> Camera | None:
        """Return the intrinsics of the depth camera where its images are registered on reading."""
        return self.registration.depth_camera if self.registration else None

    @cached_property
    def colour_name(self) -> Sequence[str]:
        """Name each colour image within the recording."""
        return [self.colour.names[row] for row in self.colour_row]

    @cached_property
    def depth_name(self) -> Sequence[str]:
        """Name each depth image within the recording, "" = none."""
        return [self.depth_images.names[row] if row >= 0 else "" for row in self.depth_row]

    def grey(self, i: int) -> np.ndarray:
        """Decode frame i's grey image, (H, W) uint8."""
        row = int(self.colour_row[i])
        return images.decode_grey(picture(self.colour, row), self.size, name=self.colour.where(row), reduction=self.reduction)

    def rgb(self, i: int) -> np.ndarray:
        """Decode frame i's colour image, (H, W, 3) uint8."""
        row = int(self.colour_row[i])
        return images.decode_rgb(picture(self.colour, row), self.size, name=self.colour.where(row), reduction=self.reduction)

    def depth(self, i: int, camera: Camera | None = None) -> np.ndarray | None:
        """Decode frame i's depth, (H, W) float32 [m], NaN where there is no reading; None where the frame has no depth image.

        camera : what is known of the camera, where that is more than the recording's calibration
        """
        row = int(self.depth_row[i])
        if row < 0:
            return None
        depth = (camera or self.camera).to_metres(depth_pixels(self.depth_images, row, self.depth_size))
        if self.registration is not None:
            return self.registration.apply(depth)
        return resized(depth, self.camera.width, self.camera.height)

    def mask(self, i: int) -> np.ndarray | None:
        """Decode frame i's mask, (H, W) bool, true where the picture must not be used; None where the frame has none."""
        row = int(self.colour_row[i])
        if self.masks is None or not self.masks.names[row] or self.masks.n_bytes(row) < 0:
            return None
        grey = images.decode_grey(picture(self.masks, row), self.size, name=self.masks.where(row))
        step = self.reduction
        return grey[: step * self.camera.height : step, : step * self.camera.width : step] > 0

    def ground_truth(self) -> Trajectory | None:
        """Return the true camera-to-world poses, None where the recording has none."""
        return self.read_ground_truth()

    def digest(self) -> str:
        """Identify the recording by calibration and each frame's stamps, names and sizes, as first asked; contents are not read."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        frames = [
            [repr(float(stamp)), repr(float(depth_stamp)), *names, self.colour.n_bytes(row), self._depth_bytes(depth_row)]
            for stamp, depth_stamp, *names, row, depth_row in zip(
                self.stamp, self.depth_stamp, self.colour_name, self.depth_name, self.colour_row, self.depth_row, strict=True
            )
        ]
        content = [self.reader, self.camera.to_dict(), frames]
        if self.registration is not None:
            content.append([self.registration.depth_camera.to_dict(), self.registration.T_cd.tolist()])
        return "sha256:" + hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def _depth_bytes(self, row: int) -> int:
        return self.depth_images.n_bytes(row) if row >= 0 else -1


def spread(n: int, wanted: int) -> list[int]:
    """Return up to `wanted` indices below n, evenly spread."""
    return sorted({int(i) for i in np.linspace(0, n - 1, num=min(n, wanted))}) if n else []
