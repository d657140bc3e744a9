"""map_server's grid map: a picture (PGM, PNG or BMP) and a YAML page beside it.

Row 0 of the picture is the largest y; row 0 of an array here is the smallest. The flip happens in this file and nowhere else.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.formats.picture import encoded, read_grey
from slamcli.schema import Grid

OCCUPIED, FREE, UNKNOWN = 1, 0, -1
GREY = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
FREE_THRESH = 0.196  # 205 reads as (255 - 205) / 255 = 0.1961: not free; with nav2's default of 0.25 unknown cells would load as free
OCCUPIED_THRESH = 0.65
MAX_PIXELS = 1 << 28
MAX_PAGE = 1 << 16  # bytes of a YAML page; a real one has some 150
PGM_WORD = re.compile(rb"#[^\n]*|[^\s#]{1,12}")
ENDINGS = (".pgm", ".png", ".bmp")
KEYS = ("image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


@dataclass(frozen=True)
class GridMap:
    """A decided grid."""

    state: np.ndarray  # (H, W) int8: 1 occupied, 0 free, -1 unknown; row 0 is the smallest y
    origin: tuple[float, float]  # m, outer corner of cell (0, 0)
    resolution: float  # m, side of a cell

    @classmethod
    def of(cls, grid: Grid) -> "GridMap":
        """Take a run's grid, its numbers without the tails that sums of cells leave (-1.1500000000000001)."""
        x, y = (round(float(value), 9) + 0.0 for value in grid.origin)
        return cls(grid.state, (x, y), round(float(grid.resolution), 9))


def write(path: Path, grid: GridMap, *, start: tuple[float, float, float] | None = None) -> tuple[Path, Path]:
    """Write `path` (.pgm, .png or .bmp) and the YAML page of the same name beside it; returns both paths.

    start : x [m], y [m], yaw [rad] where the recording began, told in a comment of the page: a robot's initial pose
    """
    path = Path(path)
    if path.suffix not in ENDINGS:
        raise SlamError(f"{path}: a grid map's name ends in {', '.join(ENDINGS)}; its page map.yaml is written beside it")
    picture = np.full(grid.state.shape, GREY[UNKNOWN], dtype=np.uint8)
    for state in (OCCUPIED, FREE):
        picture[grid.state == state] = GREY[state]
    rows, columns = grid.state.shape
    x, y = float(grid.origin[0]), float(grid.origin[1])
    page = path.with_suffix(".yaml")
    told = ""
    if start is not None:
        x_start, y_start, yaw = (round(value, 4) + 0.0 for value in start)  # + 0.0: no -0.0
        told = f"# start: x {x_start}, y {y_start}, yaw {yaw} [m, m, rad] where the recording began\n"
    text = (
        f"{told}image: {_quoted(path.name)}\nmode: trinary\nresolution: {grid.resolution!r}\norigin: [{x!r}, {y!r}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n"
    )
    if path.suffix == ".pgm":
        data = b"P5\n%d %d\n255\n" % (columns, rows) + picture[::-1].tobytes()
    else:
        data = encoded(np.ascontiguousarray(picture[::-1]), path.suffix)
    with files.whole(path) as file, files.whole(page) as page_file:  # both are complete before either gets its name
        page_file.write(text.encode())
        file.write(data)
    return path, page


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z_][\w.-]*", name) else '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'


def read(path: Path) -> GridMap:
    """Read a grid map from its YAML page, as map_server reads it in mode `trinary`.

    Raises SlamError for a page or a picture that is not one, for a turned map and for an image outside the page's folder.
    """
    path = Path(path)
    keys = _page(path)
    resolution, occupied_thresh, free_thresh = (_number(path, keys, name) for name in ("resolution", "occupied_thresh", "free_thresh"))
    origin = [_as_number(path, "origin", text) for text in keys["origin"].strip("[] ").split(",")]
    if len(origin) != 3 or origin[2] != 0.0:
        raise SlamError(f"{path}: origin {keys['origin']}: must be [x, y, 0.0]; a turned map cannot be read")
    if not 1e-4 <= resolution <= 1e3:
        raise SlamError(f"{path}: resolution {resolution:g}: must be the side of a cell in metres")
    if keys["mode"] != "trinary":
        raise SlamError(f"{path}: mode {keys['mode']!r} cannot be read, only trinary")
    if Path(keys["image"]).name != keys["image"]:
        raise SlamError(f"{path}: image {keys['image']!r}: must be the name of a file in the same folder")
    grey = np.arange(256, dtype=np.float64)
    occupied = grey / 255.0 if _number(path, keys, "negate") else (255.0 - grey) / 255.0
    state_of = np.full(256, UNKNOWN, dtype=np.int8)
    state_of[occupied > occupied_thresh] = OCCUPIED
    state_of[occupied < free_thresh] = FREE
    picture = path.parent / keys["image"]
    is_coded = picture.suffix.lower() in (".png", ".bmp")
    state = state_of[read_grey(picture, max_pixels=MAX_PIXELS) if is_coded else read_pgm(picture)]
    return GridMap(np.ascontiguousarray(state[::-1]), (origin[0], origin[1]), resolution)


def _page(path: Path) -> dict[str, str]:
    """Read the page's `key: value` lines; values stay text. No YAML beyond that is used in such pages."""
    try:
        lines = files.read_bytes(path, limit=MAX_PAGE).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SlamError(f"{path}: cannot be read as the page of a grid map; name the .yaml file") from error
    keys = {"mode": "trinary", "negate": "0"}
    for line in lines:
        name, colon, value = line.partition(":")
        if colon and name.strip() in KEYS:
            value = value.strip()
            keys[name.strip()] = (
                value[1:-1] if value[:1] == value[-1:] and value[:1] in "'\"" and len(value) > 1 else value.split(" #")[0].strip()
            )
    for name in KEYS:
        if name not in keys:
            raise SlamError(f"{path}: {name!r} is missing; not the page of a grid map")
    return keys


def _number(path: Path, keys: dict[str, str], name: str) -> float:
    return _as_number(path, name, keys[name])


def _as_number(path: Path, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SlamError(f"{path}: {name} {text[:40]!r}: not a number")
    return value


def read_pgm(path: Path) -> np.ndarray:
    """Read a binary PGM of 8 bits as (H, W) uint8, row 0 at the top."""
    try:
        with files.open_regular(path) as file:
            head = file.read(4096)
            words = [word for word in PGM_WORD.finditer(head) if not word[0].startswith(b"#")][:4]
            if len(words) < 4 or words[0][0] != b"P5" or words[3][0] != b"255" or not all(w[0].isdigit() for w in words[1:]):
                raise SlamError(f"{path}: not a binary PGM picture of 8 bits")
            columns, rows = int(words[1][0]), int(words[2][0])
            if not 1 <= rows * columns <= MAX_PIXELS:
                raise SlamError(f"{path}: {columns} x {rows} pixels: not a size a map can have")
            file.seek(words[3].end() + 1)  # one white space ends the header
            data = file.read(rows * columns)
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror})") from error
    if len(data) < rows * columns:
        raise SlamError(f"{path}: cut off: {len(data)} of {rows * columns} pixels are there; write the map again")
    return np.frombuffer(data, dtype=np.uint8).reshape(rows, columns)
