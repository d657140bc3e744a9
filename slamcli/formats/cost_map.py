"""Grids of costs for nav2's map_server in mode `scale`: any value from 0 to 100, not only free and occupied."""

from pathlib import Path

import cv2
import numpy as np

from slamcli.errors import SlamError
from slamcli.files import write_bytes

MOST = 100
ENDINGS = (".pgm", ".png")


def write(path: Path, cost: np.ndarray, *, origin: tuple[float, float], resolution: float) -> tuple[Path, Path]:
    """Write costs (H, W), 0 to 100, -1 = unknown, as a picture and the YAML page beside it; returns both paths.

    Row 0 is the smallest y. A .png keeps unknown cells, as transparent ones; .pgm cannot, and they become as bad as an obstacle.
    """
    path = Path(path)
    if path.suffix not in ENDINGS:
        raise SlamError(f"{path}: a cost map's name ends in {' or '.join(ENDINGS)}; its page is written beside it")
    is_unknown = cost[::-1] < 0
    shade = np.rint(255.0 - np.where(is_unknown, MOST, cost[::-1]) * (255.0 / MOST)).astype(np.uint8)
    page = path.with_suffix(".yaml")
    if path.suffix == ".pgm":
        data = b"P5\n%d %d\n255\n" % shade.shape[::-1] + shade.tobytes()
    else:
        opacity = np.where(is_unknown, 0, 255).astype(np.uint8)
        data = cv2.imencode(".png", np.stack([shade, shade, shade, opacity], axis=-1))[1].tobytes()
    write_bytes(path, data)
    name = '"' + path.name.replace("\\", "\\\\").replace('"', '\\"') + '"'
    text = (
        f"image: {name}\nmode: scale\nresolution: {resolution!r}\norigin: [{origin[0]!r}, {origin[1]!r}, 0.0]\n"
        "negate: 0\noccupied_thresh: 1.0\nfree_thresh: 0.0\n"
    )
    write_bytes(page, text.encode())
    return path, page
