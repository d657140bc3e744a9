"""Write any recording in the TUM layout."""

from pathlib import Path

import cv2
import numpy as np

from slamcli.console import Progress, silent
from slamcli.datasets.protocol import Dataset
from slamcli.datasets.staging import staged
from slamcli.errors import BadFrame, SlamError
from slamcli.formats.trajectory import write_tum
from slamcli.geometry.camera import DEPTH_VALUES

DEPTH_SCALE = 5000.0
COARSEST = 100.0  # units a metre: of a smaller depth scale whole numbers say too little
MOST_WARNINGS = 20


def write_tum_layout(dataset: Dataset, out: Path, *, progress: Progress = silent) -> list[str]:
    """Write colour and depth as PNG with their lists, the calibration and the truth into the new folder `out`; returns warnings.

    Depth is written in the units of the recording where these are whole numbers, so that no reading changes; else 5000 units a metre.
    The folder appears only when complete.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SlamError(f"{out}: exists already; name a new folder")
    scale = dataset.camera.depth_scale if dataset.camera.depth_scale >= COARSEST else DEPTH_SCALE
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    warnings: list[str] = []
    with staged(out) as staging:
        for name in lists:
            (staging / name).mkdir()
        for i in progress(range(len(dataset)), "convert", len(dataset)):
            try:
                _write(staging, "rgb", float(dataset.stamp[i]), cv2.cvtColor(dataset.rgb(i), cv2.COLOR_RGB2BGR), lists)
                depth = dataset.depth(i)
                if depth is not None:
                    _write(staging, "depth", float(dataset.depth_stamp[i]), _whole(depth, scale), lists)
            except BadFrame as error:
                warnings.append(str(error))
        if not lists["rgb"] or not lists["depth"]:
            raise SlamError(f"{dataset.root}: no frame could be read, the first because: {(warnings or ['no depth'])[0]}")
        for name, lines in lists.items():
            (staging / f"{name}.txt").write_text(f"# {name} images of {dataset.name}\n# stamp file\n" + "\n".join(lines) + "\n")
        camera = {**dataset.camera.to_dict(), "depth_scale": scale}
        lines = [f"{key} = {value!r}" if not isinstance(value, str) else f'{key} = "{value}"' for key, value in camera.items()]
        (staging / "camera.toml").write_text("\n".join(lines) + "\n")
        truth = _truth(dataset, warnings)
        if truth is not None:
            write_tum(staging / "groundtruth.txt", truth)
    more = [f"{len(warnings) - MOST_WARNINGS} more images could not be read"] if len(warnings) > MOST_WARNINGS else []
    return warnings[:MOST_WARNINGS] + more


def _write(folder: Path, name: str, stamp: float, image: np.ndarray, lists: dict[str, list[str]]) -> None:
    file = f"{name}/{stamp:.6f}.png"
    if not cv2.imwrite(str(folder / file), image):
        raise SlamError(f"{folder / file}: cannot be written")
    lists[name].append(f"{stamp:.6f} {file}")


def _whole(depth: np.ndarray, scale: float) -> np.ndarray:
    """Round depth (H, W) [m] to whole units, 0 = none; what is too far for 16 bits counts as none."""
    raw = np.rint(np.nan_to_num(depth.astype(np.float64) * scale))
    return np.where((raw > 0) & (raw < DEPTH_VALUES - 1), raw, 0).astype(np.uint16)


def _truth(dataset: Dataset, warnings: list[str]):
    try:
        return dataset.ground_truth()
    except SlamError as error:
        warnings.append(str(error))
        return None
