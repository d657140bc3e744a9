"""The layouts that open. A reader is one module here and one row of READERS.

A reader's module has ``recognises(path) -> bool``, which looks at names only, and ``read(path) -> Recorded``, which finds images, stamps
and calibration; everything after that is the same for all and is done in `slamcli.datasets.assembly`.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slamcli.datasets.recorded import Recorded


@dataclass(frozen=True)
class Reader:
    """One layout."""

    name: str  # its module
    title: str
    told_by: str
    extra: str = ""  # what of slamcli[...] it needs beside a plain install

    @property
    def recognises(self) -> Callable[[Path], bool]:
        """Say whether a path looks like this layout."""
        return self._module().recognises

    @property
    def read(self) -> "Callable[[Path], Recorded]":
        """Find images, stamps and calibration."""
        return self._module().read

    def _module(self):
        return importlib.import_module(f"slamcli.datasets.readers.{self.name}")


# The more telling first: a folder is read by the first that recognises it.
READERS = (Reader("tum", "TUM RGB-D, ETH3D-SLAM, Bonn", "rgb.txt and depth.txt"),)


def reader_of(path: Path) -> Reader | None:
    """Give the reader that recognises a path."""
    return next((reader for reader in READERS if reader.recognises(path)), None)
