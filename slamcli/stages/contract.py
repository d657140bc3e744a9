"""What a stage is, and what it is given: its inputs, a folder, its settings, and tools. It knows no more of a run."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from slamcli.config.options import Config
from slamcli.datasets import Dataset
from slamcli.geometry.camera import Camera

Item = TypeVar("Item")
Record = TypeVar("Record")
Summary = dict[str, Any]  # what a stage says of itself, JSON values; "frames" counts the frames that it went through


class Stored(Protocol):
    """The folders of stages: of a run, or those that a stage may read."""

    def load(self, cls: type[Record], stage: str) -> Record:
        """Read a record of arrays that `stage` wrote, to be read alone: their memory may be let go, and what was written with it."""

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


class StageFunction(Protocol):
    """The function `run` of a stage's file: load the inputs, call the numerical packages, save what they return."""

    def __call__(self, inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
        """Write the stage's files into the empty folder `out` and return what there is to count.

        inputs : what the stage's row of `STAGES` declares in `needs`; anything else is an error
        out : takes the place of the stage's folder when this returns, and is dropped when it raises
        cfg : the seed, and of the sections those that the row declares in `config`; any other is an error, as a change in it would go unnoticed
        Raises SlamError for what a user can mend.
        """
