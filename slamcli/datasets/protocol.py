"""What the program needs of a recording; every reader's result meets it, and nothing outside this package knows more."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from slamcli.geometry.camera import Camera
from slamcli.schema import Trajectory


class Dataset(Protocol):
    """F colour frames in the order of time, each with a depth image or without.

    Frames are decoded on demand and from several threads at once; an image that cannot be used raises BadFrame then, so that one bad
    frame costs one frame. Everything that made the result differ from what the recording literally says is told in `warnings`.
    """

    @property
    def reader(self) -> str:
        """Name the layout."""

    @property
    def name(self) -> str:
        """Name the recording, such as "tum/fr1_xyz"; runs/<name> is where a run goes."""

    @property
    def root(self) -> Path:
        """Name the folder or file."""

    @property
    def stamp(self) -> np.ndarray:
        """Return the time of each colour frame, (F,) float64 [s], increasing."""

    @property
    def depth_stamp(self) -> np.ndarray:
        """Return the time of the depth image paired with it, (F,) float64 [s], NaN = the frame has none."""

    @property
    def camera(self) -> Camera:
        """Return the intrinsics of the pictures as they are delivered; depth is delivered in their pixels."""

    @property
    def depth_camera(self) -> Camera | None:
        """Return the intrinsics of the depth camera where its images are registered on reading; None = they are delivered as recorded."""

    @property
    def warnings(self) -> list[str]:
        """List what opening the recording had to put right or to assume."""

    @property
    def colour_name(self) -> Sequence[str]:
        """Name each colour image, for messages and lists."""

    @property
    def depth_name(self) -> Sequence[str]:
        """Name each depth image, "" = none."""

    def __len__(self) -> int: ...

    def grey(self, i: int) -> np.ndarray:
        """Decode frame i's grey image, (H, W) uint8."""

    def rgb(self, i: int) -> np.ndarray:
        """Decode frame i's colour image, (H, W, 3) uint8, red first."""

    def depth(self, i: int, camera: Camera | None = None) -> np.ndarray | None:
        """Decode frame i's depth, (H, W) float32 [m], NaN where there is no reading; None where the frame has no depth image.

        camera : what is known of the camera, where that is more than the recording's calibration
        """

    def mask(self, i: int) -> np.ndarray | None:
        """Decode frame i's mask, (H, W) bool, true where the picture must not be used; None where the frame has none."""

    def ground_truth(self) -> Trajectory | None:
        """Read the true camera-to-world poses, None where the recording has none."""

    def digest(self) -> str:
        """Identify the recording by calibration and each frame's stamps, names and sizes; contents are not read."""
