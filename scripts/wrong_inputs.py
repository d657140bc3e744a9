#!/usr/bin/env python
"""Recordings that are wrong in one way each, and what `run` says of them; and good ones, of which it must say nothing.

    python scripts/wrong_inputs.py OUT [--seed 1] [--size 320 240] [--frames 60] [--cases NAME ...] [--good] [--shift 0] [--tum FOLDER]

A small room is simulated and spoilt in one way after the other. Each line of the table names a case, the finding that puts the run in
doubt, if its cause is the right one, the error of the poses, and the first words. With --good rooms of many seeds, sizes and kinds
follow, --shift being added to the seeds, and with --tum stretches of fr1_xyz and fr3_teddy. OUT keeps recordings and runs, which are
used again.
"""

import argparse
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import slamcli
from slamcli import console, inspection
from slamcli.console import table
from slamcli.datasets import Dataset
from slamcli.datasets.simulate import simulate
from slamcli.errors import SlamError
from slamcli.runs.run_directory import RunDir
from slamcli.slam import doubt
from slamcli.slam.doubt import Finding
from slamcli.stages import NAMES

HEADINGS = ["case", "in doubt for", "right", "APE [m]", "said"]
SHOWN = 90  # letters of what is said
LAPS_PER_FRAME = 0.004  # walking speed at 15 Hz
REFUSED = "refused"

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


def scaled(**factor: float) -> Callable[[Path], None]:
    """Multiply numbers of the calibration."""
    return lambda folder: camera(folder, **{name: lambda value, f=f: value * f for name, f in factor.items()})


def added(**amount: float) -> Callable[[Path], None]:
    """Add to numbers of the calibration."""
    return lambda folder: camera(folder, **{name: lambda value, a=a: value + a for name, a in amount.items()})


# What is wrong, how it is made, and the causes of which one must be named; a refusal names it too. Not among them is what no image shows:
# depth in a unit 10 % off, within which cameras of one kind differ, and colour and depth both mirrored.
CASES: dict[str, tuple[Callable[[Path], None], set[str]]] = {
    "fx, fy halved": (scaled(fx=0.5, fy=0.5), {"focal_length"}),
    "fx, fy doubled": (scaled(fx=2.0, fy=2.0), {"focal_length"}),
    "fx, fy x 1.15": (scaled(fx=1.15, fy=1.15), {"focal_length"}),
    "fx, fy x 0.8": (scaled(fx=0.8, fy=0.8), {"focal_length"}),
    "cx 20 px off": (added(cx=20.0), {"principal_point"}),
    "cy 20 px off": (added(cy=-20.0), {"principal_point"}),
    "cx 20 px off the other way": (added(cx=-20.0), {"principal_point"}),
    "cy 20 px off the other way": (added(cy=20.0), {"principal_point"}),
    "cx 30 px off": (added(cx=30.0), {"principal_point"}),
    "depth x 1.5": (depth(lambda d: np.minimum(np.rint(d * 1.5), 65535).astype(np.uint16)), {"depth_scale"}),
    "depth scale x 1.5": (scaled(depth_scale=1.5), {"depth_scale"}),
    "depth shifted by 10 px": (depth(partial(shifted, pixels=10)), {"registration", "depth_shift"}),
    "depth shifted by 20 px": (depth(shifted), {"registration"}),
    "one depth image": (frozen("depth"), {"frozen_depth"}),
    "one colour image": (frozen("rgb"), {"frozen_colour"}),
    "both frozen": (frozen("rgb", "depth"), {"frozen"}),
    "depth constant": (depth(lambda d: np.full_like(d, 10000)), {"depth_readings"}),
    "depth random": (depth(noise), {"depth_readings"}),
    "depth byte-swapped": (depth(lambda d: d.byteswap()), {REFUSED}),
    "k1 = 1e6": (added(k1=1e6), {REFUSED}),
    "k1 = 1e300": (added(k1=1e300), {REFUSED}),
    "k1 = 0.4": (added(k1=0.4), {"lens"}),
    "depth one frame late": (lambda folder: images(folder, "depth", lambda pictures: [pictures[0], *pictures[:-1]]), {"depth_delay"}),
    "depth one frame early": (lambda folder: images(folder, "depth", lambda pictures: [*pictures[1:], pictures[-1]]), {"depth_delay"}),
    "colour mirrored": (
        lambda folder: images(folder, "rgb", lambda pictures: [picture[:, ::-1] for picture in pictures]),
        {"registration"},
    ),
    "all depth zero": (depth(np.zeros_like), {"depth_readings"}),
}

ROOMS: dict[str, dict[str, Any]] = {
    **{f"room {seed}": {"seed": seed} for seed in range(30, 40)},
    **{f"bare {share:g}": {"seed": 50, "textured": share} for share in (0.0, 0.15, 0.3)},
    **{f"dark {seed}": {"seed": seed, "dark": True} for seed in (60, 61)},
    **{f"people {n}": {"seed": 70 + n, "people": n} for n in (1, 2)},
    "exact": {"seed": 90, "noise": "none"},
    "slow": {"seed": 92, "laps": 0.08},
    "corridor": {"seed": 91, "alias": "corridor"},
}
BLUR = {"blurred 2": 2.0, "blurred 4": 4.0}  # [px] at a width of 640
SIZES = ((320, 240), (640, 480), (160, 120))  # of the rooms in turn
STRETCHES = {f"fr1_xyz from {start} s": ("rgbd_dataset_freiburg1_xyz", start, start + 4) for start in range(0, 28, 4)}
STRETCHES |= {"fr3_teddy": ("rgbd_dataset_freiburg3_teddy", 0, 0)}


def main() -> None:
    """Make what is missing, run it, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES), metavar="NAME")
    parser.add_argument("--good", action="store_true", help="also good recordings")
    parser.add_argument("--shift", type=int, default=0, help="added to the good rooms' seeds [0]")
    parser.add_argument("--tum", type=Path, help="folder of the TUM recordings fr1_xyz and fr3_teddy")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows = spoilt(given.out / f"room{given.seed}_{given.size[0]}", given) if given.cases else []
    rows += good(given.out / f"good{given.shift}", given.frames, shift=given.shift) if given.good else []
    rows += recorded(given.out / "tum", given.tum) if given.tum else []
    print(table([HEADINGS, *rows]))
    print(f"{sum(row[2] == 'yes' for row in rows)} of {len(rows)} as they should be")


def spoilt(home: Path, given: argparse.Namespace) -> list[list[str]]:
    """Run the room as it is, and each way to spoil it."""
    size = {"width": given.size[0], "height": given.size[1]}
    sound = room(home / "sound", {"seed": given.seed, "frames": given.frames, "laps": LAPS_PER_FRAME * given.frames, **size})
    rows = [row("as it is", sound, set())]
    for name in given.cases:
        spoil, causes = CASES[name]
        folder = home / plain(name)
        if not folder.exists():
            spoil(copy(sound, folder))
        rows.append(row(name, folder, causes))
    return rows


def good(home: Path, frames: int, *, shift: int = 0) -> list[list[str]]:
    """Run rooms that are as they should be."""
    rows = []
    for k, (name, settings) in enumerate(ROOMS.items()):
        width, height = SIZES[k % len(SIZES)]
        drive = {"frames": frames, "laps": LAPS_PER_FRAME * frames, "width": width, "height": height}
        rows.append(row(name, room(home / plain(name), {**drive, **settings, "seed": settings["seed"] + shift}), set()))
    for name, sigma in BLUR.items():
        folder = home / plain(name)
        if not folder.exists():
            blur(copy(room(home / "room_30", {}), folder), sigma)
        rows.append(row(name, folder, set()))
    return rows


def blur(folder: Path, sigma: float) -> None:
    """Blur the pictures of a recording."""
    images(folder, "rgb", lambda pictures: [cv2.GaussianBlur(one, (0, 0), sigma * one.shape[1] / 640) for one in pictures])


def recorded(home: Path, tum: Path) -> list[list[str]]:
    """Run stretches of recordings of a real camera."""
    home.mkdir(parents=True, exist_ok=True)
    stretches = STRETCHES.items()
    return [row(name, tum / of, set(), home / plain(name), {"recording.start": a, "recording.end": b}) for name, (of, a, b) in stretches]


def room(folder: Path, settings: dict[str, Any]) -> Path:
    """Simulate a room where that was not done."""
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        simulate(folder, progress=console.progress, **settings)
    return folder


def row(name: str, recording: Path, causes: set[str], run: Path | None = None, settings: dict[str, Any] | None = None) -> list[str]:
    """Run a recording up to loop and compare what puts it in doubt with what should; no cause = nothing should."""
    try:
        directory = slamcli.run(
            recording, path=run or recording.with_suffix(".run"), until="loop", settings=settings or {}, look=look,
            progress=console.progress, tell=console.say,
        ).directory  # fmt: skip
        found = findings(directory)
        error = ape(directory)
    except SlamError as refusal:
        found, error = [Finding(REFUSED, str(refusal), is_grave=True)], "-"
    names = {finding.name for finding in found}
    is_right = bool(names & causes) if causes else not names
    told = [name, ", ".join(sorted(names)), "yes" if is_right else "NO", error, found[0].text[:SHOWN] if found else ""]
    print(table([told]), flush=True)
    return told


def look(dataset: Dataset) -> list[Finding]:
    """Look at a recording as the command line does."""
    return inspection.doubts(inspection.quick_look(dataset))


def findings(run: RunDir) -> list[Finding]:
    """Return what puts a run in doubt."""
    records = {stage: run.record(stage) for stage in NAMES}
    return [finding for finding in doubt.from_records(records) if finding.is_grave]


def ape(run: RunDir) -> str:
    """Return the error of the poses, a dash where there is none to give."""
    try:
        return f"{slamcli.open_run(run.path).ape().rmse:.4f}"
    except SlamError:
        return "-"


def plain(name: str) -> str:
    """Make a folder's name of a case's."""
    return "".join(letter for letter in name.replace(" ", "_") if letter not in ",=.")


if __name__ == "__main__":
    main()
