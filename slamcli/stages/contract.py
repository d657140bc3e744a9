"""What a stage is given: its inputs, its settings, and tools. A stage is `run(inputs, out, cfg, tools) -> summary` and knows no more of a run."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from slamcli.datasets import Dataset
from slamcli.geometry.camera import Camera

Item = TypeVar("Item")
Record = TypeVar("Record")
Summary = dict[str, Any]  # what a stage says of itself, JSON values; "frames" counts the frames that it went through


class Stored(Protocol):
    """The folders of stages: of a run, or those that a stage may read."""

    def load(self, cls: type[Record], stage: str) -> Record:
        """Read a record of arrays that `stage` wrote."""

    def camera(self, stage: str = "extract") -> Camera:
        """Read the intrinsics that extract used, or those known after optimize or loop."""


class Inputs(Stored, Protocol):
    """What a stage may read: the stages that it declares in `STAGES`, and the recording where it declares "dataset"."""

    @property
    def dataset(self) -> Dataset:
        """The recording."""

    def path(self, stage: str, *names: str) -> Path:
        """Name a file that `stage` wrote."""


class Tools(Protocol):
    """What a stage may use beside its inputs."""

    workers: int  # threads; no byte of the output may depend on them

    def progress(self, iterable: Iterable[Item], label: str, total: int | None = None) -> Iterator[Item]:
        """Pass items through and tell the user how far the stage is."""

    def warn(self, message: str) -> None:
        """Tell the user of something that was worked round; the stage's record keeps it."""

    def rng(self) -> np.random.Generator:
        """Return the stage's own random numbers: the same for the same seed, whatever ran before."""
