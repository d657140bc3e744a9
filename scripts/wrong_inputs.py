#!/usr/bin/env python
"""Recordings that are wrong in one way each, and what `run` says of them; sound recordings, and that nothing is said of these.

    python scripts/wrong_inputs.py OUT [--seed 1] [--size 320 240] [--frames 60] [--cases NAME ...] [--good] [--tum FOLDER]

A small room is simulated and spoilt in one way after the other. The table gives for each case the signs that the stages found, whether one
of those that name its cause is among them, and what the run says first. OUT keeps recordings and runs, which are used again.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import slamcli
from slamcli import console
from slamcli.console import table
from slamcli.datasets.simulate import simulate
from slamcli.errors import SlamError
from slamcli.slam import doubt
from slamcli.stages import NAMES

HEADINGS = ["case", "as it should be", "signs", "APE [m]", "said"]
SHOWN = 110  # letters of what is said
LAPS_PER_FRAME = 0.004  # at 15 Hz: walking speed

Images = list[np.ndarray]


def copy(source: Path, target: Path) -> Path:
    """Link a recording to another place, so that changing the copy leaves the original alone."""
    shutil.copytree(source, target, copy_function=lambda a, b: Path(b).symlink_to(Path(a).resolve()))
    return target


def replace_text(path: Path, text: str) -> None:
    """Write a file anew, never through a link."""
    path.unlink()
    path.write_text(text)


def camera(folder: Path, **change: Callable[[float], float]) -> None:
    """Change numbers of the calibration."""
    values = json.loads((folder / "camera.json").read_text())
    replace_text(folder / "camera.json", json.dumps(values | {name: of(values.get(name, 0.0)) for name, of in change.items()}))


def images(folder: Path, kind: str, change: Callable[[Images], Images]) -> None:
    """Change the images of one list, all at once."""
    names = [line.split()[1] for line in (folder / f"{kind}.txt").read_text().splitlines() if not line.startswith("#")]
    before = [cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in names]
    for name, image in zip(names, change(before), strict=True):
        (folder / name).unlink()
        cv2.imwrite(str(folder / name), image)


def depth(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Change each depth image by itself."""
    return lambda folder: images(folder, "depth", lambda pictures: [change(picture) for picture in pictures])


def frozen(*kinds: str) -> Callable[[Path], None]:
    """Repeat one image in the place of all."""

    def change(folder: Path) -> None:
        for kind in kinds:
            images(folder, kind, lambda pictures: [pictures[len(pictures) // 2]] * len(pictures))

    return change


def shifted(picture: np.ndarray, pixels: int = 20) -> np.ndarray:
    """Move an image to the right."""
    out = np.zeros_like(picture)
    out[:, pixels:] = picture[:, :-pixels]
    return out


def noise(picture: np.ndarray) -> np.ndarray:
    """Return readings without any sense."""
    rng = np.random.default_rng(int(picture.sum()) % 2**31)
    return rng.integers(1000, 25000, picture.shape).astype(np.uint16)


# What is wrong, how it is made, and the signs of which one must be found.
CASES: dict[str, tuple[Callable[[Path], None], set[str]]] = {
    "fx, fy halved": (lambda f: camera(f, fx=lambda x: x / 2, fy=lambda x: x / 2), {"focal_length"}),
    "fx, fy doubled": (lambda f: camera(f, fx=lambda x: x * 2, fy=lambda x: x * 2), {"focal_length"}),
    "fx, fy x 1.15": (lambda f: camera(f, fx=lambda x: x * 1.15, fy=lambda x: x * 1.15), {"focal_length"}),
    "cx 20 px off": (lambda f: camera(f, cx=lambda x: x + 20), {"principal_point"}),
    "cy 20 px off": (lambda f: camera(f, cy=lambda x: x - 20), {"principal_point"}),
    "depth x 1.5": (depth(lambda d: np.minimum(np.rint(d * 1.5), 65535).astype(np.uint16)), {"depth_scale"}),
    "depth scale x 1.5": (lambda f: camera(f, depth_scale=lambda x: x * 1.5), {"depth_scale"}),
    "depth shifted by 20 px": (depth(shifted), {"registration"}),
    "one depth image": (frozen("depth"), {"frozen_depth"}),
    "one colour image": (frozen("rgb"), {"frozen_colour"}),
    "both frozen": (frozen("rgb", "depth"), {"frozen_colour", "frozen_depth"}),
    "depth constant": (depth(lambda d: np.full_like(d, 10000)), {"depth_readings", "frozen_depth"}),
    "depth random": (depth(noise), {"depth_readings"}),
    "depth byte-swapped": (depth(lambda d: d.byteswap()), {"depth_readings"}),
    "k1 = 1e6": (lambda f: camera(f, k1=lambda x: 1e6), {"lens"}),
    "k1 = 1e300": (lambda f: camera(f, k1=lambda x: 1e300), {"lens"}),
    "k1 = 0.4": (lambda f: camera(f, k1=lambda x: 0.4), {"lens", "focal_length"}),
    "depth one frame late": (lambda f: images(f, "depth", lambda d: [d[0], *d[:-1]]), {"depth_delay"}),
    "all depth zero": (depth(np.zeros_like), {"depth_readings"}),
}  # fmt: skip
