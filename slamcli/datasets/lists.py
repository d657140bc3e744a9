"""Lists of images as people write them: stamp and file, colour and depth side by side, with or without the truth."""

import math
import re
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from slamcli import files
from slamcli.datasets.folder import COLOUR_FOLDERS, DEPTH_FOLDERS, Folder
from slamcli.errors import SlamError

MAX_LIST_BYTES = 256 << 20
MAX_LINE = 4096  # characters; no line of a list is longer
NUMBER = r"[+-]?(?:(?:\d+(?:[.]\d*)?|[.]\d+)(?:[eE][+-]?\d+)?|nan|inf)"
DECIMAL_COMMA = r"[+-]?\d+,\d+"
# A comma within a number is a decimal comma where white space or a semicolon follows the number; else commas separate.
STAMP_FIRST = (
    re.compile(rf"\s*[\"']?({DECIMAL_COMMA})[\"']?\s*[;\s]\s*(.*\S)\s*$"),
    re.compile(rf"\s*[\"']?({NUMBER})[\"']?\s*[,;\s]\s*(.*\S)\s*$", re.IGNORECASE),
)
STAMP_LAST = re.compile(rf"\s*(\S.*?)\s*[,;\s]\s*[\"']?({DECIMAL_COMMA}|{NUMBER})[\"']?\s*$", re.IGNORECASE)
WHOLE_NUMBER = re.compile(rf"[\"']?({DECIMAL_COMMA}|{NUMBER})[\"']?$", re.IGNORECASE)
DATE = re.compile(
    r"(?<![^\s,;\"'])(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d+))?(Z|[+-]\d\d:?\d\d)?(?=[\s,;\"']|$)"  # as ISO 8601 writes it
)
BRACKETS = {"(": ")", "[": "]", "{": "}"}
LARGEST_STAMP = 1e19  # [ns] since 1970, in the year 2286; no stamp in any unit is larger
EARLIEST, NANOSECONDS = 5e8, 1e9  # [s] since 1970 of any recording; in a second
POSE_COLUMNS = 8  # stamp tx ty tz qx qy qz qw


@dataclass(frozen=True)
class ImageList:
    """One list, in its own order."""

    path: Path
    stamp: np.ndarray  # (N,) float64 as written
    names: list[str]  # relative to the folder
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class PairList:
    """One list of colour and depth images side by side, in its own order."""

    path: Path
    stamp: np.ndarray | None  # (N,) of colour as written; None = the list has none
    depth_stamp: np.ndarray | None
    colour: list[str]
    depth: list[str]
    poses: np.ndarray | None  # (N, 8) stamp tx ty tz qx qy qz qw of the truth joined to it
    warnings: list[str] = field(default_factory=list)


def read_list(path: Path, folder: Folder | None = None) -> ImageList:
    """Read a list of images: lines ``stamp file`` or ``file stamp``, `#` comments.

    Commas, semicolons and tabs may separate, decimal commas and UTF-16 are read. Lines that cannot be used are left out with a warning,
    as are second copies of a line; a list without any usable line and file names that lead out of the folder are errors.
    """
    folder = folder or Folder(path.parent)
    homes = DEPTH_FOLDERS if "depth" in path.name.lower() else COLOUR_FOLDERS
    entries: list[tuple[float, str]] = []
    bad_lines: list[int] = []
    for number, line in data_lines(path):
        entry = _stamp_and_name(line)
        if entry is None:
            if number > 1 or any(c.isdigit() for c in line):  # else it is a heading
                bad_lines.append(number)
            continue
        name = _found(folder, entry[1], path, number, homes)
        _refuse_more_columns(folder, name, path, number)
        entries.append((entry[0], name))
    if not entries:
        raise SlamError(f"{path}: lists no image; expected lines 'stamp file'")
    warnings = _unusable(path, bad_lines)
    unique = list(dict.fromkeys(entries))
    if len(unique) < len(entries):
        warnings.append(f"{path}: {len(entries) - len(unique)} repeated lines left out")
    return ImageList(path, np.array([stamp for stamp, _ in unique]), [name for _, name in unique], warnings)


def read_pairs(path: Path, folder: Folder | None = None) -> PairList:
    """Read an association file: ``stamp colour stamp depth`` in either order, with one stamp or none, the truth before or behind or not."""
    folder = folder or Folder(path.parent)
    rows: list[tuple[list[float], list[str], list[float], list[float]]] = []
    bad_lines: list[int] = []
    for number, line in data_lines(path):
        row = _pair_row(columns(line))
        if row is None:
            if number > 1 or any(c.isdigit() for c in line):
                bad_lines.append(number)
            continue
        rows.append((row[0], [_found(folder, name, path, number) for name in row[1]], row[2], row[3]))
    if not rows:
        raise SlamError(f"{path}: lists no pair of images; expected lines 'stamp colour-image stamp depth-image'")
    first_is_depth = _first_is_depth(folder, [row[1] for row in rows], path)
    colour, depth = (1, 0) if first_is_depth else (0, 1)
    stamps = np.array([row[0] for row in rows]) if len({len(row[0]) for row in rows}) == 1 else np.empty((len(rows), 0))
    has_stamps = stamps.shape[1] == 2
    has_poses = all(len(row[2]) == POSE_COLUMNS for row in rows)
    return PairList(
        path=path,
        stamp=stamps[:, colour] if has_stamps else None,
        depth_stamp=stamps[:, depth] if has_stamps else None,
        colour=[row[1][colour] for row in rows],
        depth=[row[1][depth] for row in rows],
        poses=np.array([row[2] for row in rows]) if has_poses else None,
        warnings=_unusable(path, bad_lines),
    )


def data_lines(path: Path) -> list[tuple[int, str]]:
    """Return (line number, text) of the lines that hold data."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    return [(number, _plain(line[:MAX_LINE])) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


def _plain(line: str) -> str:
    """Return a line without brackets around it, with semicolons for upright bars and seconds since 1970 for dates."""
    text = line.strip().rstrip(",")
    if text and BRACKETS.get(text[0]) == text[-1]:
        line = text[1:-1]
    return DATE.sub(_seconds, line.replace("|", ";"))


def _seconds(date: re.Match) -> str:
    day, time, fraction, zone = date.groups()
    try:
        moment = datetime.fromisoformat(f"{day}T{time}{zone or 'Z'}")
    except ValueError:  # a month 13
        return str(date.group())
    return f"{round(moment.timestamp())}.{fraction or '0'}"


def read_text(path: Path) -> str:
    """Read a text file in UTF-8 or UTF-16, with a mark of byte order or without."""
    try:
        data = files.read_bytes(path, limit=MAX_LIST_BYTES)
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror})") from error
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16", errors="replace")
    elif data[:200].count(0) > len(data[:200]) // 3:
        text = data.decode("utf-16-le" if data[1:2] == b"\0" else "utf-16-be", errors="replace")
    else:
        text = data.decode("utf-8", errors="replace")
    return text.replace("\ufeff", "")


def to_float(token: str) -> float:
    """Parse a number with a decimal point or a decimal comma; NaN for anything else."""
    if not WHOLE_NUMBER.match(token):
        return math.nan
    try:
        return float(token.strip("\"'").replace(",", "."))
    except ValueError:
        return math.nan


def columns(line: str) -> list[str]:
    """Split a line at semicolons, else tabs, else at white space and commas; a comma between digits may be a decimal comma."""
    for mark in (";", "\t"):
        if mark in line:
            return [part.strip().strip("\"'") for part in line.split(mark) if part.strip()]
    parts: list[str] = []
    for part in line.split():
        part = part.strip(",")
        is_decimal = re.fullmatch(r"[+-]?\d+,\d+", part) and "." not in line.split()[0]
        parts += [part] if is_decimal else [piece for piece in part.split(",") if piece]
    return [part.strip("\"'") for part in parts]


def _stamp_and_name(line: str) -> tuple[float, str] | None:
    """Take a line of two columns apart; None where it has no finite stamp or no name."""
    found = _number_first(line)
    if found:
        stamp, rest = to_float(found.group(1)), found.group(2)
        while (more := _number_first(rest)) is not None:  # an index before the stamp, or seconds and nanoseconds
            second = to_float(more.group(1))
            stamp, rest = (stamp + 1e-9 * second if _is_nanoseconds(stamp, second) else second), more.group(2)
    else:
        found = STAMP_LAST.match(line)
        if not found:
            return None
        stamp, rest = to_float(found.group(2)), found.group(1)
    name = re.split(r"[\t;]", rest)[0].strip().strip(",").strip("\"'").strip()
    is_name = name and not WHOLE_NUMBER.fullmatch(name)
    return (stamp, name) if is_name and abs(stamp) <= LARGEST_STAMP else None


def _number_first(text: str) -> re.Match | None:
    return next((found for pattern in STAMP_FIRST if (found := pattern.match(text))), None)


def _is_nanoseconds(seconds: float, rest: float) -> bool:
    return seconds > EARLIEST and seconds.is_integer() and 0 <= rest < NANOSECONDS and rest.is_integer()  # never infinite


def _pair_row(tokens: list[str]) -> tuple[list[float], list[str], list[float], list[float]] | None:
    """Sort the columns of an association: (stamps of both files, files, pose, rest); None where they make no sense."""
    values = [to_float(token) for token in tokens]
    files = [k for k, value in enumerate(values) if math.isnan(value) and not WHOLE_NUMBER.fullmatch(tokens[k])]
    if len(files) != 2:
        return None
    first, second = files
    names = [tokens[first], tokens[second]]
    before, between, behind = values[:first], values[first + 1 : second], values[second + 1 :]
    if len(between) == 1 and before:
        stamps, pose = [before[-1], between[0]], before[:-1] or behind
    elif not between and before:
        stamps, pose = [before[-1], before[-1]], before[:-1] or behind
    elif len(between) == 1 and behind:  # file stamp file stamp
        stamps, pose = [between[0], behind[0]], behind[1:]
    elif not before and not between:
        stamps, pose = [], behind
    else:
        return None
    if not all(abs(stamp) <= LARGEST_STAMP for stamp in stamps):
        return None
    return stamps, names, pose if len(pose) == POSE_COLUMNS and np.isfinite(pose).all() else [], []


def _first_is_depth(folder: Folder, names: list[list[str]], path: Path) -> bool:
    """Tell which of the two columns is depth: by the word in the name, else by the pixels."""
    said = ["depth" in names[0][k].lower() or names[0][k].lower().endswith((".exr", ".npy")) for k in (0, 1)]
    if said[0] != said[1]:
        return said[0]
    from slamcli.datasets import images
    from slamcli.errors import BadFrame

    for first, second in names[:20]:
        kinds = []
        for name in (first, second):
            try:
                images.decode_depth(images.read_bytes(folder.root / name), name=name)
                kinds.append(True)
            except BadFrame:
                kinds.append(False)
        if kinds[0] != kinds[1]:
            return kinds[0]
    raise SlamError(f"{path}: it cannot be told which of {names[0][0]} and {names[0][1]} is depth; depth must have 16 bits a pixel")


def _found(folder: Folder, name: str, path: Path, number: int, homes: tuple[str, ...] = ()) -> str:
    try:
        return folder.find(name, homes)
    except SlamError as error:
        raise SlamError(f"{path}:{number}: {error}") from None


def _refuse_more_columns(folder: Folder, name: str, path: Path, number: int) -> None:
    """Raise SlamError where a name is no file, but its first word is: a comment or further columns follow it."""
    first, *rest = re.split(r"[\s,]+", name, maxsplit=1)
    if rest and not folder.has(name) and folder.has(first):
        raise SlamError(
            f"{path}:{number}: {rest[0]!r} follows the file name {first}; a line has a stamp and a file, a comment a line of its own; "
            "a list of pairs is called associations.txt"
        )


def _unusable(path: Path, bad_lines: list[int]) -> list[str]:
    return [f"{path}: {len(bad_lines)} unusable lines left out, the first is line {bad_lines[0]}"] if bad_lines else []
