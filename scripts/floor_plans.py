#!/usr/bin/env python
"""Compare the walls of floor plans with the simulated rooms that they are of: lengths and angles.

    python scripts/floor_plans.py OUT [--seeds 11 12 13 14 15 16] [--frames 240]

For each seed a room is rendered, mapped and drawn. A room has four walls: each is compared with the wall of the plan nearest in length
among those whose direction fits and whose ends are corners, and each corner with a right angle. OUT keeps recordings and runs; what is there is used again.
"""

import argparse
import json
from pathlib import Path

import numpy as np

import slamcli
from slamcli import console
from slamcli.datasets.simulate import simulate
from slamcli.navigation.walls import Wall

LEAST = 0.6  # of a room's side: a shorter wall is a piece of one, or furniture


def main() -> None:
    """Print a row for each room, and the worst of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13, 14, 15, 16])
    parser.add_argument("--frames", type=int, default=240)
    given = parser.parse_args()
    errors, turns = [], []
    for seed in given.seeds:
        recording = given.out / f"room{seed}"
        if not recording.exists():
            simulate(recording, progress=console.progress, seed=seed, frames=given.frames, laps=1.0)
        run = slamcli.run(recording, path=given.out / f"run{seed}", progress=console.progress)
        plan = run.floor_plan()
        room = json.loads((recording / "scene.json").read_text())["room"]
        sides = np.abs(np.subtract(room["max"], room["min"]))[:2]
        off, turned = compared(plan.walls, sides)
        errors += off
        turns += turned
        rooms = ", ".join(f"{one.area:.1f}" for one in plan.rooms.rooms)
        worst = f"{max(off):.3f} m, {max(turned):.2f} degrees" if off else "no wall"
        print(f"seed {seed}: {len(off)} of 4 walls, worst {worst}; rooms {rooms} m2 of {sides.prod():.1f}", flush=True)
    print(f"{len(errors)} lengths, worst {max(errors):.3f} m; {len(turns)} angles, worst {max(turns):.2f} degrees")


def compared(walls: list[Wall], sides: np.ndarray) -> tuple[list[float], list[float]]:
    """Return by how much the lengths of the room's walls are off [m], and the angles between neighbours from right ones [degrees]."""
    corners = [end for wall in walls for end in (wall.start, wall.end)]
    long = [wall for wall in walls if wall.length > LEAST * sides.min() and is_whole(wall, corners)]
    if not long:
        return [], []
    along = np.array([wall.end - wall.start for wall in long])
    angle = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
    first = angle[int(np.argmax(np.linalg.norm(along, axis=1)))]
    is_long_side = np.abs((angle - first + 45.0) % 180.0 - 45.0) < 45.0
    found: list[float] = []
    for side, chosen in ((sides.max(), is_long_side), (sides.min(), ~is_long_side)):
        off = sorted(abs(wall.length - side) for wall, here in zip(long, chosen, strict=True) if here)
        found += off[:2]
    turned = [abs((value - first + 45.0) % 90.0 - 45.0) for value in angle if value != first]
    return found, turned


def is_whole(wall: Wall, ends: list[np.ndarray]) -> bool:
    """Say whether a wall ends in corners with others: of one that was seen in part the length is not told."""
    return all(sum(bool(np.linalg.norm(end - other) < 1e-6) for other in ends) > 1 for end in (wall.start, wall.end))


if __name__ == "__main__":
    main()
