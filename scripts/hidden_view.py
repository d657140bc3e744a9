"""Tell what people cost from what the loss of their part of the view costs: drives without anybody, with that part hidden, beside drives with people.

    python scripts/hidden_view.py FOLDER [--rooms 5] [--first 21] [--frames 250] [--people 1,4] [--draws 3]

FOLDER is that of people.py; what it lacks is made. Of each room and number of people, APE: of the drive with people, under the masks that are
found and under the true ones; of the drive without anybody, whole, with the true masks of those people hidden, and with as large a share
of its features hidden at random, least and greatest of --draws. Where the last ones are no better than the first, the masks are not to blame.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
from people import call, record

from slamcli import console
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Moving
from slamcli.slam import depth_views, moving_objects
from slamcli.stages import moving_parts, track

HEADINGS = ("room", "people", "cover", "found masks", "true masks", "nobody", "masks of people hidden", "as many features hidden")


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=5)
    parser.add_argument("--first", type=int, default=21)
    parser.add_argument("--frames", type=int, default=250)
    parser.add_argument("--people", default="1,4")
    parser.add_argument("--draws", type=int, default=3)
    given = parser.parse_args()
    rows = []
    for room in range(given.first, given.first + given.rooms):
        alone = record(given.folder, room, 0, given.frames)
        for count in (int(text) for text in given.people.split(",")):
            crowded = record(given.folder, room, count, given.frames)
            share, shown = cover(crowded), given.folder / f"hidden_{crowded.name}"
            with hidden(lambda shape, source=crowded: true_masks(source, shape)):
                masked = [ape(recording, shown / f"true_{recording.name}") for recording in (crowded, alone)]
            thinned = []
            for draw in range(given.draws):
                with hidden(lambda shape: np.ones(shape, dtype=bool)), thinning(share, draw):
                    thinned.append(ape(alone, shown / f"thinned_{draw}"))
            found, whole = ape(crowded, shown / "found"), ape(alone, shown / "nobody")
            spread = f"{min(thinned):.4f} to {max(thinned):.4f}"
            rows.append([str(room), str(count), f"{share:.0%}", *(f"{e:.4f}" for e in (found, masked[0], whole, masked[1])), spread])
            print(console.table([list(HEADINGS), rows[-1]]), flush=True)
    print(console.table([list(HEADINGS), *rows]))


def ape(recording: Path, run: Path) -> float:
    """Run a recording up to loop where that was not done; returns its APE [m]."""
    if not (run / "loop").exists():
        call("run", recording, "-r", run, "--until", "loop", "--force")
    return json.loads(call("eval", "ape", run, "--json"))["rmse"]


def mask_files(recording: Path) -> list[Path]:
    """List the images of what moves, in order of time."""
    return sorted((recording / "moving").iterdir(), key=lambda path: float(path.stem))


def cover(recording: Path) -> float:
    """Compute the mean share of the view that people cover."""
    return float(np.mean([(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0).mean() for path in mask_files(recording)]))


def true_masks(recording: Path, shape: tuple[int, int, int]) -> np.ndarray:
    """Read what moves as a mask (F, v, u) bool: a place counts where one of its pixels does."""
    masks = np.zeros(shape, dtype=bool)
    for mask, path in zip(masks, mask_files(recording), strict=True):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0
        side = image.shape[0] // shape[1]
        mask[:] = image[: side * shape[1], : side * shape[2]].reshape(shape[1], side, shape[2], side).any(axis=(1, 3))
    return masks


@contextmanager
def hidden(masks: Callable[[tuple[int, int, int]], np.ndarray]) -> Iterator[None]:
    """Have all stages hide these masks in place of those that they would find."""

    def find(inputs: object, *_: object, **__: object) -> Moving:
        return Moving(masks((len(moving_parts.coarse_images(inputs)), *depth_views.shape(inputs.camera()))))

    with (
        patch.object(moving_parts, "are_any", lambda *_: True),
        patch.object(moving_parts, "find", find),
        patch.object(track, "_find_background", lambda inputs, *_: (find(inputs), None)),
    ):
        yield


@contextmanager
def thinning(share: float, seed: int) -> Iterator[None]:
    """Have features hidden at random in place of those under a mask, and nothing of the depth."""

    def hide(features: Features, moving: np.ndarray, camera: Camera) -> Features:
        if len(moving) == 0:
            return features
        is_hidden = np.random.default_rng(seed).random(len(features.xy)) < share
        xy, depth = np.array(features.xy), np.array(features.depth)
        xy[is_hidden], depth[is_hidden] = moving_objects.OUT_OF_SIGHT, np.nan
        return replace(features, xy=xy, depth=depth)

    with patch.object(moving_objects, "hide_features", hide), patch.object(moving_objects, "hide_coarse", lambda images, *_: images):
        yield


if __name__ == "__main__":
    main()
