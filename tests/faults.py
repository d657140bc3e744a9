"""Spoil a recording in the TUM layout in one known way at a time."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np


def copy(source: Path, target: Path, *, camera: dict | None = None) -> Path:
    """Link a recording to another place, so that changing the copy's files leaves the original alone."""
    shutil.copytree(source, target, copy_function=lambda a, b: Path(b).symlink_to(Path(a).resolve()))
    for name in ("rgb.txt", "depth.txt", "camera.json"):
        if (target / name).exists():
            text = (target / name).read_text()
            (target / name).unlink()
            (target / name).write_text(text)
    if camera is not None and not (target / "camera.json").exists():
        (target / "camera.json").write_text(json.dumps(camera))
    return target


def entries(folder: Path, kind: str) -> list[tuple[float, str]]:
    lines = [line.split() for line in (folder / f"{kind}.txt").read_text().splitlines() if not line.startswith("#")]
    return [(float(stamp), name) for stamp, name in lines]


def write(folder: Path, kind: str, rows: list[tuple[float, str]]) -> None:
    (folder / f"{kind}.txt").write_text("".join(f"{stamp:.6f} {name}\n" for stamp, name in rows))


def repaint(folder: Path, kind: str, change: Callable[[np.ndarray], np.ndarray], which: slice = slice(None)) -> None:
    """Change images of a list."""
    for _, name in entries(folder, kind)[which]:
        picture = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        (folder / name).unlink()
        cv2.imwrite(str(folder / name), change(picture))


def anonymize(folder: Path) -> Path:
    """Name files by number instead of by stamp."""
    for kind in ("rgb", "depth"):
        rows = []
        for k, (stamp, name) in enumerate(entries(folder, kind)):
            new = f"{kind}/{k:06d}{Path(name).suffix}"
            (folder / name).rename(folder / new)
            rows.append((stamp, new))
        write(folder, kind, rows)
    return folder


def depth_in_millimetres(folder: Path) -> None:
    repaint(folder, "depth", lambda d: (d // 5).astype(np.uint16))


def scale_of_1000(folder: Path) -> None:
    camera = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps({**camera, "depth_scale": 1000.0}))


def _swap(folder: Path, kind: str, i: int, k: int) -> None:
    rows = entries(folder, kind)
    rows[i], rows[k] = (rows[i][0], rows[k][1]), (rows[k][0], rows[i][1])
    write(folder, kind, rows)


def swapped_stamps_far(folder: Path) -> None:
    n = len(entries(folder, "rgb"))
    _swap(folder, "rgb", n // 3, 2 * n // 3)


def swapped_stamps_near(folder: Path) -> None:
    n = len(entries(folder, "rgb"))
    for k in range(n // 4, 3 * n // 4, 9):
        _swap(folder, "rgb", k, k + 1)


def swapped_depth_stamps(folder: Path) -> None:
    n = len(entries(folder, "depth"))
    _swap(folder, "depth", n // 3, 2 * n // 3)


def shifted(depth: np.ndarray, dx: int, dy: int) -> np.ndarray:
    moved = cv2.warpAffine(depth.astype(np.float32), np.float32([[1, 0, dx], [0, 1, dy]]), depth.shape[::-1], flags=cv2.INTER_NEAREST)
    return moved.astype(np.uint16)


def shifted_right(folder: Path) -> None:
    repaint(folder, "depth", lambda d: shifted(d, 8 * d.shape[1] // 640, 0))


def shifted_up(folder: Path) -> None:
    repaint(folder, "depth", lambda d: shifted(d, 0, -8 * d.shape[1] // 640))


def half_of_the_depth_list(folder: Path) -> None:
    write(folder, "depth", entries(folder, "depth")[::2])


def half_of_the_depth_files(folder: Path) -> None:
    for _, name in entries(folder, "depth")[::2]:
        (folder / name).unlink()


def half_of_each_depth_image(folder: Path) -> None:
    repaint(folder, "depth", lambda d: np.where(np.arange(d.shape[1]) < d.shape[1] // 2, 0, d).astype(np.uint16))


def half_of_the_depth_pixels(folder: Path) -> None:
    rng = np.random.default_rng(0)
    repaint(folder, "depth", lambda d: np.where(rng.random(d.shape) < 0.5, 0, d).astype(np.uint16))


def half_of_the_recording_without_depth(folder: Path) -> None:
    rows = entries(folder, "depth")
    write(folder, "depth", rows[: len(rows) // 2])


def gap(folder: Path) -> None:
    rows = entries(folder, "rgb")
    start = rows[len(rows) // 4][0]
    for kind in ("rgb", "depth"):
        write(folder, kind, [row for row in entries(folder, kind) if not start < row[0] < start + 2.0])


def gap_by_stamps(folder: Path) -> None:
    rows = entries(folder, "rgb")
    start = rows[len(rows) // 2][0]
    for kind in ("rgb", "depth"):
        write(folder, kind, [(stamp + 2.0 * (stamp > start), name) for stamp, name in entries(folder, kind)])


def blurred(folder: Path) -> None:
    repaint(folder, "rgb", lambda c: cv2.GaussianBlur(c, (0, 0), 3.0 * c.shape[1] / 640))


def blurred_in_part(folder: Path) -> None:
    n = len(entries(folder, "rgb"))
    repaint(folder, "rgb", lambda c: cv2.GaussianBlur(c, (0, 0), 3.0 * c.shape[1] / 640), slice(n // 2, n // 2 + n // 10))


def blurred_by_motion(folder: Path) -> None:
    def streak(picture: np.ndarray) -> np.ndarray:
        length = 15 * picture.shape[1] // 640 | 1
        return cv2.filter2D(picture, -1, np.full((1, length), 1.0 / length))

    repaint(folder, "rgb", streak)


def overexposed(folder: Path) -> None:
    repaint(folder, "rgb", lambda c: np.clip(c.astype(np.float32) * 2.2, 0, 255).astype(np.uint8))


def overexposed_by_offset(folder: Path) -> None:
    repaint(folder, "rgb", lambda c: np.clip(c.astype(np.int32) + 120, 0, 255).astype(np.uint8))


def overexposed_in_part(folder: Path) -> None:
    n = len(entries(folder, "rgb"))
    change = slice(n // 2, n // 2 + n // 10)
    repaint(folder, "rgb", lambda c: np.clip(c.astype(np.float32) * 2.5, 0, 255).astype(np.uint8), change)


def empty_depth(folder: Path) -> None:
    repaint(folder, "depth", np.zeros_like)


def empty_depth_in_part(folder: Path) -> None:
    n = len(entries(folder, "depth"))
    repaint(folder, "depth", np.zeros_like, slice(n // 2, n // 2 + n // 10))


def make_late(folder: Path, seconds: float) -> None:
    write(folder, "depth", [(stamp + seconds, name) for stamp, name in entries(folder, "depth")])


def depth_late(folder: Path) -> None:
    make_late(folder, 0.05)


def depth_early(folder: Path) -> None:
    make_late(folder, -0.05)


def unsorted_list(folder: Path) -> None:
    rows = entries(folder, "rgb")
    write(folder, "rgb", [rows[i] for i in np.random.default_rng(0).permutation(len(rows))])


def unsorted_depth_list(folder: Path) -> None:
    write(folder, "depth", entries(folder, "depth")[::-1])


# fault -> the checks of which one must speak; first the ten plain ones, then their variants
FAULTS: dict[Callable[[Path], None], set[str]] = {
    depth_in_millimetres: {"depth scale"},
    swapped_stamps_far: {"order"},
    shifted_right: {"registration"},
    half_of_the_depth_list: {"unmatched"},
    gap: {"gaps"},
    blurred: {"blur"},
    overexposed: {"exposure"},
    empty_depth: {"empty depth"},
    depth_late: {"time offset"},
    unsorted_list: {"lists"},
}
VARIANTS: dict[Callable[[Path], None], set[str]] = {
    scale_of_1000: {"depth scale"},
    swapped_stamps_near: {"order"},
    swapped_depth_stamps: {"order"},
    shifted_up: {"registration"},
    half_of_the_depth_files: {"files"},
    half_of_each_depth_image: {"holes"},
    half_of_the_depth_pixels: {"holes"},
    half_of_the_recording_without_depth: {"unmatched"},
    gap_by_stamps: {"gaps"},
    blurred_in_part: {"blur"},
    blurred_by_motion: {"blur"},
    overexposed_by_offset: {"exposure"},
    overexposed_in_part: {"exposure"},
    empty_depth_in_part: {"empty depth"},
    depth_early: {"time offset"},
    unsorted_depth_list: {"lists"},
}
