"""Which depth image goes with which colour image, as a file beside the features."""

from pathlib import Path

import numpy as np

from slamcli import files
from slamcli.datasets import Dataset


def write_association(path: Path, dataset: Dataset, depth_stamp: np.ndarray) -> None:
    """Write which depth image goes with which colour image, in the format of the TUM tools: stamp, path, stamp, path."""
    lines = ["# colour stamp [s], colour image, depth stamp [s], depth image; commented out: no usable depth image"]
    for stamp, colour, with_depth, depth in zip(dataset.stamp, dataset.colour_name, depth_stamp, dataset.depth_name, strict=True):
        lines.append(f"{stamp:.6f} {colour} {with_depth:.6f} {depth}" if np.isfinite(with_depth) else f"# {stamp:.6f} {colour}")
    files.write_text(path, "\n".join(lines) + "\n")
