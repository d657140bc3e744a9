"""The pictures a vocabulary is trained on."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from slamcli.config.options import ExtractConfig
from slamcli.datasets import images, open_dataset
from slamcli.errors import BadFrame, SlamError
from slamcli.parallel import ordered_map
from slamcli.vision import orb

SUFFIXES = {".jpg", ".jpeg", ".png", ".ppm", ".pgm", ".bmp", ".tif", ".tiff", ".webp"}
WORKERS = 2

Picture = Callable[[], np.ndarray]


def descriptors(
    sources: Sequence[str], *, features: int, every: int, progress: Callable = lambda items, label, total=None: items
) -> list[np.ndarray]:
    """Return the descriptors (N_i, 32) uint8 of each picture of folders of pictures and of each `every`-th frame of recordings.

    Pictures that cannot be used are left out; SlamError where a source has none.
    """
    pictures = [picture for source in sources for picture in _pictures(source, every)]
    found = progress(ordered_map(partial(_describe, features), pictures, workers=WORKERS), "features", len(pictures))
    return [desc for desc in found if len(desc)]


def _describe(features: int, picture: Picture) -> np.ndarray:
    try:
        return orb.detect(picture(), ExtractConfig(features=features)).desc
    except BadFrame:
        return orb.no_key_points().desc


def _pictures(source: str, every: int) -> Iterable[Picture]:
    folder = Path(source)
    if folder.is_dir() and (files := sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)):
        return [partial(_grey, path) for path in files]
    if folder.is_dir() and not (folder / "rgb.txt").exists():
        raise SlamError(f"{source}: neither pictures ({', '.join(sorted(SUFFIXES))}) nor a recording")
    dataset = open_dataset(source)
    return [partial(dataset.grey, i) for i in range(0, len(dataset), every)]


def _grey(path: Path) -> np.ndarray:
    data = images.read_bytes(path)
    return images.decode_grey(data, images.picture_size(data, str(path)), name=str(path))
