"""A grid against the scene it was made from: which cells are right, and which obstacles were missed.

What counts as seen is told by exact depth from true poses, at the pixels where the recording has a reading within the grid's range.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.navigation.grid import FREE, OCCUPIED, UNKNOWN
from slamcli.schema import Grid

SUBCELLS = 5  # samples along a cell's side
ON_FLOOR = 1e-6  # [m]
OUTLINE_POINTS = 3  # points of the band a cell must have shown to count as a seen outline
BEFORE = 0.15  # share of the true depth by which a reading is nearer at most: at edges and far off noise takes a tenth
LARGEST = 1e6  # [m] of a scene, so that no square overflows
SPECIAL = ("hanging_box", "low_box")


@dataclass(frozen=True)
class TrueRoom:
    """A room and the solids in it, level frame, metres and radians."""

    low: np.ndarray  # (3,) corner of the room with the smallest coordinates
    high: np.ndarray  # (3,) the opposite corner
    solids: list[dict[str, Any]]  # as in scene.json

    def occupied(self, xy: np.ndarray, low: float, high: float) -> np.ndarray:
        """Say whether points (..., 2) lie outside the room or within a solid that reaches into the heights from low to high."""
        inside = np.asarray(((xy < self.low[:2]) | (xy > self.high[:2])).any(axis=-1))
        for solid in self.solids:
            inside |= footprint(solid, xy, low, high)
        return inside


def read_scene(path: Path) -> TrueRoom:
    """Read scene.json; SlamError when it is not one."""
    try:
        about = json.loads(files.read_bytes(path, limit=files.LARGEST_JSON).decode("utf-8"))
        low, high = (_numbers(about["room"][name], 3) for name in ("min", "max"))
        return TrueRoom(np.array(low), np.array(high), [_solid(one) for one in about["obstacles"]])
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror}); only simulated recordings have it") from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise SlamError(f"{path}: not the scene of a simulated recording") from error


def _solid(about: dict[str, Any]) -> dict[str, Any]:
    """Check a box or a cylinder of scene.json; ValueError, KeyError or TypeError where it is neither."""
    if about["type"] not in ("box", "cylinder"):
        raise ValueError(about["type"])
    sizes = (
        {"size": _numbers(about["size"], 3), "yaw": _numbers([about["yaw"]], 1)[0]}
        if about["type"] == "box"
        else dict(zip(("radius", "height"), _numbers([about["radius"], about["height"]], 2), strict=True))
    )
    return {**about, **sizes, "centre": _numbers(about["centre"], 3), "name": str(about["name"])}


def _numbers(values: Any, n: int) -> list[float]:
    """Return a list of n numbers; ValueError or TypeError for anything else."""
    found = [float(value) for value in values]
    if not isinstance(values, list) or len(found) != n or not np.isfinite(found).all() or np.abs(found).max() > LARGEST:
        raise ValueError(f"{n} finite numbers are expected")
    return found


def footprint(solid: dict[str, Any], xy: np.ndarray, low: float, high: float) -> np.ndarray:
    """Say whether points (..., 2) lie within a solid's outline, all False if it does not reach into the heights from low to high."""
    is_box = solid["type"] == "box"
    centre, height = np.array(solid["centre"]), solid["size"][2] if is_box else solid["height"]
    if centre[2] - height / 2 >= high or centre[2] + height / 2 <= low:
        return np.zeros(xy.shape[:-1], dtype=bool)
    local = xy - centre[:2]
    if not is_box:
        return (local**2).sum(axis=-1) <= solid["radius"] ** 2
    c, s = np.cos(solid["yaw"]), np.sin(solid["yaw"])
    along, across = local[..., 0] * c + local[..., 1] * s, local[..., 1] * c - local[..., 0] * s
    return (np.abs(along) <= solid["size"][0] / 2) & (np.abs(across) <= solid["size"][1] / 2)


def cast(scene: TrueRoom, origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Return the multiple of each ray (N, 3) from `origin` (3,) at which it meets a wall, floor, ceiling or solid."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = _through_slabs(origin, ray, scene.low, scene.high)[1]
        for solid in scene.solids:
            is_box = solid["type"] == "box"
            centre, yaw = np.array(solid["centre"]), solid["yaw"] if is_box else 0.0
            c, s = np.cos(yaw), np.sin(yaw)
            R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            start, along = R @ (origin - centre), ray @ R.T
            if is_box:
                half = 0.5 * np.array(solid["size"])
                enter, leave = _through_slabs(start, along, -half, half)
            else:
                enter, leave = _through_cylinder(start, along, solid["radius"], solid["height"])
            distance = np.where((enter <= leave) & (enter > 0.0), np.minimum(distance, enter), distance)
    return distance


def _through_slabs(start: np.ndarray, ray: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = (low - start) / ray, (high - start) / ray
    return np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)


def _through_cylinder(start: np.ndarray, ray: np.ndarray, radius: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    a, b = (ray[:, :2] ** 2).sum(axis=1), ray[:, :2] @ start[:2]
    root = np.sqrt(b * b - a * (start[:2] @ start[:2] - radius**2))  # NaN where the ray passes by: no comparison holds then
    low, high = (-0.5 * height - start[2]) / ray[:, 2], (0.5 * height - start[2]) / ray[:, 2]
    return np.maximum((-b - root) / a, np.minimum(low, high)), np.minimum((-b + root) / a, np.maximum(low, high))


def exact_points(scene: TrueRoom, depth: np.ndarray, T_sk: np.ndarray, camera: Camera, *, max_range: float, stride: int = 4) -> np.ndarray:
    """Return the points (N, 3) that every `stride`-th pixel with a reading up to max_range [m] truly showed.

    A reading far before all of the scene shows what is no part of it, such as somebody who walks by.
    """
    seen = depth[::stride, ::stride] <= max_range
    rays = camera.rays[::stride, ::stride][seen].astype(np.float64)
    ray = np.column_stack([rays, np.ones(len(rays))]) @ T_sk[:3, :3].T
    true = cast(scene, T_sk[:3, 3], ray)
    shows = depth[::stride, ::stride][seen] > (1.0 - BEFORE) * true
    return T_sk[:3, 3] + ray[shows] * true[shows, None]


@dataclass(frozen=True)
class GridScore:
    """Shares in [0, 1]. With one cell of tolerance unless the name says exact."""

    free_is_free: float  # cells called free that hold nothing of the band, or lie next to one that holds nothing
    free_is_free_exact: float
    floor_is_free: float  # of the floor seen, away from obstacles: called free
    floor_is_free_exact: float  # of all the floor seen
    floor_is_occupied: float  # of the floor seen, away from obstacles: called occupied
    outline_is_occupied: float  # of the outline cells seen: occupied, or next to an occupied cell
    outline_is_occupied_exact: float
    n_free: int
    n_floor: int
    n_outline: int
    special: dict[str, dict[str, int]]  # per special box: cells on it, occupied, free, unknown; outline cells seen, of these occupied

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return asdict(self)


def score(grid: Grid, scene: TrueRoom, T_sl: np.ndarray, points: Iterable[np.ndarray], *, band: tuple[float, float]) -> GridScore:
    """Compare a grid with the truth.

    T_sl : (4, 4), grid's level frame to the scene's
    points : per key frame the points (N, 3) [scene] it truly showed, by `exact_points`
    """
    floor, outline = seen(grid, T_sl, points, band=band)
    is_any = sample(grid, scene, T_sl, band).any(axis=-1) | outline  # a face on a cell's very border is in no sample
    floor &= ~is_any
    near = _grown(is_any)
    occupied, free = grid.state == OCCUPIED, grid.state == FREE
    away = floor & ~near
    deep = ~_grown(~is_any)  # no neighbour is free of obstacles
    return GridScore(
        free_is_free=_share(free & ~deep, free),
        free_is_free_exact=_share(free & ~is_any, free),
        floor_is_free=_share(free & away, away),
        floor_is_free_exact=_share(free & floor, floor),
        floor_is_occupied=_share(occupied & away, away),
        outline_is_occupied=_share(_grown(occupied) & outline, outline),
        outline_is_occupied_exact=_share(occupied & outline, outline),
        n_free=int(free.sum()),
        n_floor=int(away.sum()),
        n_outline=int(outline.sum()),
        special=_special(grid, scene, T_sl, band, outline),
    )


def _special(grid: Grid, scene: TrueRoom, T_sl: np.ndarray, band: tuple[float, float], outline: np.ndarray) -> dict[str, dict[str, int]]:
    """Count the states of the cells that lie on each special box for more than half, and its seen outline as `outline_is_occupied` does."""
    counts = {}
    occupied = grid.state == OCCUPIED
    for solid in scene.solids:
        if solid["name"] in SPECIAL:
            share = sample(grid, TrueRoom(np.full(3, -np.inf), np.full(3, np.inf), [solid]), T_sl, band).mean(axis=-1)
            states, seen_there = grid.state[share > 0.5], outline & (share > 0.0)
            counts[solid["name"]] = {
                "cells": len(states), "occupied": int((states == OCCUPIED).sum()), "free": int((states == FREE).sum()),
                "unknown": int((states == UNKNOWN).sum()),
                "outline": int(seen_there.sum()), "outline_occupied": int((seen_there & _grown(occupied)).sum()),
            }  # fmt: skip
    return counts


def sample(grid: Grid, scene: TrueRoom, T_sl: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    """Say for the samples of each cell (H, W, 25) whether something of the band is there."""
    rows, columns = grid.state.shape
    sub = (np.arange(SUBCELLS) + 0.5) / SUBCELLS
    out = np.empty((rows, columns, SUBCELLS * SUBCELLS), dtype=bool)
    x = grid.origin[0] + (np.arange(columns)[:, None] + sub).ravel() * float(grid.resolution)
    for row in range(rows):
        y = grid.origin[1] + (row + sub) * float(grid.resolution)
        xy = np.stack(np.meshgrid(x, y), axis=-1)
        there = scene.occupied(xy @ T_sl[:2, :2].T + T_sl[:2, 3], *band)
        out[row] = there.reshape(SUBCELLS, columns, SUBCELLS).transpose(1, 0, 2).reshape(columns, -1)
    return out


def seen(grid: Grid, T_sl: np.ndarray, points: Iterable[np.ndarray], *, band: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells (H, W) whose floor was seen, and those that showed at least a few points of the band."""
    shape = grid.state.shape
    floor, in_band = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=np.int64)
    T_ls = se3.inverse(T_sl)
    for xyz in points:
        cell = np.floor((se3.transform(T_ls, xyz)[:, :2] - grid.origin) / float(grid.resolution)).astype(np.int64)
        inside = (cell >= 0).all(axis=1) & (cell[:, 0] < shape[1]) & (cell[:, 1] < shape[0])
        low = inside & (xyz[:, 2] < ON_FLOOR)
        floor[cell[low, 1], cell[low, 0]] = True
        fits = inside & (xyz[:, 2] > band[0]) & (xyz[:, 2] < band[1])
        np.add.at(in_band, (cell[fits, 1], cell[fits, 0]), 1)
    return floor, in_band >= OUTLINE_POINTS


def _grown(cells: np.ndarray) -> np.ndarray:
    """Add the eight neighbours of each cell."""
    import cv2

    return cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _share(part: np.ndarray, whole: np.ndarray) -> float:
    n = int(whole.sum())
    return int((part & whole).sum()) / n if n else 1.0
