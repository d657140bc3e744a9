"""Furniture, each piece a list of solids around a place on the floor.

A piece stands with its back at y = 0 and its front towards -y; `Piece.at` turns it and puts the middle of its back somewhere.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slamcli.datasets.simulated import picture as p
from slamcli.datasets.simulated import texture as t
from slamcli.datasets.simulated.brush import INK, PALETTES, PAPER, Colour, pick, tint
from slamcli.datasets.simulated.scene import Solid, box, cylinder

OAK, WALNUT, PINE, WHITE = (186, 142, 92), (112, 76, 50), (214, 178, 126), (232, 228, 220)
WOODS = (OAK, WALNUT, PINE, WHITE)
FABRICS: tuple[tuple[Colour, Colour], ...] = (
    ((58, 96, 128), (224, 196, 120)), ((140, 62, 58), (236, 214, 190)),
    ((88, 112, 82), (238, 226, 170)), ((120, 104, 134), (250, 214, 200)),
)  # fmt: skip


@dataclass(frozen=True)
class Piece:
    """A piece of furniture in its own frame."""

    name: str
    width: float  # [m] along its back
    depth: float  # [m]
    height: float  # [m]
    solids: list[Solid]

    def at(self, x: float, y: float, yaw: float) -> list[Solid]:
        """Return its solids with the middle of the back at (x, y), turned by `yaw` [rad]."""
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return [replace(solid, centre=R @ solid.centre + [x, y, 0.0], yaw=solid.yaw + yaw) for solid in self.solids]


def bookcase(name: str, rng: np.random.Generator) -> Piece:
    """Open shelves with rows of books set back a little."""
    width, depth, height = rng.uniform(0.8, 1.3), 0.32, rng.uniform(1.3, 2.0)
    colour = pick(rng, WOODS)
    plank = {"": t.wood(colour, 18.0)}
    solids = [
        box(f"{name}/left", (-width / 2 + 0.015, -depth / 2, 0.0), (0.03, depth, height), {"": t.wood(colour, 18.0, along_x=False)}),
        box(f"{name}/right", (width / 2 - 0.015, -depth / 2, 0.0), (0.03, depth, height), {"": t.wood(colour, 18.0, along_x=False)}),
        box(f"{name}/back", (0.0, -0.01, 0.0), (width - 0.06, 0.02, height), {"": t.wood(tint(colour, 0.7), 14.0)}),
    ]
    n_rows = int(height / 0.36)
    pitch = (height - 0.09) / n_rows
    for row in range(n_rows + 1):
        z = 0.06 + row * pitch
        solids.append(box(f"{name}/shelf_{row}", (0.0, -depth / 2, z), (width - 0.06, depth, 0.03), plank))
        if row < n_rows:
            share = rng.uniform(0.45, 1.0)
            long, high, deep = (width - 0.08) * share, (pitch - 0.03) * rng.uniform(0.7, 0.9), rng.uniform(0.16, 0.24)
            x = rng.uniform(-0.5, 0.5) * (width - 0.08 - long)
            sides = {"": t.flat((120, 110, 100)), "front": p.books, "top": t.flat((222, 214, 196))}
            solids.append(box(f"{name}/books_{row}", (x, -0.02 - deep / 2, z + 0.03), (long, deep, high), sides))
    return Piece(name, width, depth, height, solids)


def cabinet(name: str, rng: np.random.Generator) -> Piece:
    """Chest of drawers with something on top."""
    width, depth, height = rng.uniform(0.8, 1.3), rng.uniform(0.4, 0.5), rng.uniform(0.6, 1.0)
    colour = pick(rng, WOODS)
    front = p.drawers(colour, int(rng.integers(2, 4)), int(rng.integers(1, 4)))
    body = box(f"{name}/body", (0.0, -depth / 2, 0.0), (width, depth, height), {"": t.wood(colour), "front": front, "top": p.desk(colour)})
    return Piece(name, width, depth, height + 0.4, [body, *_on_top(name, rng, width, depth, height)])


def table(name: str, rng: np.random.Generator, width: float = 0.0, depth: float = 0.0) -> Piece:
    """Table on four legs with things on it."""
    width, depth, height = width or rng.uniform(1.2, 1.6), depth or rng.uniform(0.6, 0.75), rng.uniform(0.7, 0.76)
    colour = pick(rng, WOODS)
    top = box(f"{name}/top", (0.0, -depth / 2, height - 0.04), (width, depth, 0.04), {"": t.wood(colour), "top": p.desk(colour)})
    leg = {"": t.wood(colour, along_x=False)}
    legs = [
        box(f"{name}/leg_{k}", (sx * (width / 2 - 0.06), -depth / 2 + sy * (depth / 2 - 0.06), 0.0), (0.06, 0.06, height - 0.04), leg)
        for k, (sx, sy) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    ]  # fmt: skip
    return Piece(name, width, depth, height + 0.4, [top, *legs, *_on_top(name, rng, width, depth, height)])


def desk_with_screen(name: str, rng: np.random.Generator) -> Piece:
    """Desk against the wall with a monitor and a chair before it."""
    piece = table(name, rng)
    z = piece.solids[0].centre[2] + 0.02
    monitor = [
        box(f"{name}/monitor", (0.0, -0.16, z + 0.1), (0.58, 0.04, 0.36), {"": t.flat((40, 40, 44)), "front": p.screen}),
        box(f"{name}/stand", (0.0, -0.16, z), (0.2, 0.14, 0.1), {"": t.flat((52, 52, 58))}),
    ]
    on_top = [solid for solid in piece.solids if "item" not in solid.name]
    return Piece(name, piece.width, piece.depth, z + 0.5, [*on_top, *monitor])


def sofa(name: str, rng: np.random.Generator) -> Piece:
    """Sofa with cushions."""
    width, depth = rng.uniform(1.5, 1.9), 0.75
    colour, accent = pick(rng, FABRICS)
    cloth = {"": t.fabric(colour, accent)}
    solids = [
        box(f"{name}/seat", (0.0, -depth / 2, 0.0), (width, depth, 0.4), cloth),
        box(f"{name}/back", (0.0, -0.1, 0.4), (width, 0.2, 0.42), cloth),
        box(f"{name}/arm_left", (-width / 2 + 0.09, -depth / 2 - 0.1, 0.4), (0.18, depth - 0.2, 0.2), cloth),
        box(f"{name}/arm_right", (width / 2 - 0.09, -depth / 2 - 0.1, 0.4), (0.18, depth - 0.2, 0.2), cloth),
    ]
    for k, x in enumerate((-0.28 * width, 0.25 * width)):
        pattern = {"": pick(rng, (p.mosaic, p.shapes))}
        solids.append(box(f"{name}/cushion_{k}", (x, -0.28, 0.4), (0.42, 0.14, 0.38), pattern, yaw=rng.uniform(-0.25, 0.25)))
    return Piece(name, width, depth, 0.82, solids)


def parcels(name: str, rng: np.random.Generator) -> Piece:
    """Stack of cardboard boxes."""
    solids, z, width = [], 0.0, rng.uniform(0.5, 0.65)
    for k in range(int(rng.integers(2, 4))):
        size = np.array([width, 0.8 * width, rng.uniform(0.28, 0.42)]) * (1.0 - 0.12 * k)
        solids.append(box(f"{name}/box_{k}", (rng.uniform(-0.03, 0.03), -0.3, z), size, {"": p.cardboard}, yaw=rng.uniform(-0.15, 0.15)))
        z += size[2]
    return Piece(name, width + 0.1, 0.6, z, solids)


def plant(name: str, rng: np.random.Generator) -> Piece:
    """Bush in a pot."""
    pot = cylinder(
        f"{name}/pot", (0.0, -0.25, 0.0), 0.17, 0.34, {"": pick(rng, (p.mosaic, t.brick((190, 104, 72)))), "top": t.flat((70, 52, 40))}
    )
    leaves = {"": t.foliage((96, 168, 72))}
    stem = cylinder(f"{name}/stem", (0.0, -0.25, 0.34), 0.025, 0.2, {"": t.wood((110, 84, 56))})
    crown = [
        cylinder(f"{name}/crown_{k}", (rng.uniform(-0.03, 0.03), -0.25, z), r, 0.24, leaves)
        for k, (z, r) in enumerate(((0.54, 0.2), (0.78, 0.24), (1.02, 0.17)))
    ]  # fmt: skip
    return Piece(name, 0.5, 0.5, 1.26, [pot, stem, *crown])


def bin_and_lamp(name: str, rng: np.random.Generator) -> Piece:
    """Standard lamp beside a waste bin."""
    solids = [
        cylinder(f"{name}/foot", (0.12, -0.2, 0.0), 0.14, 0.03, {"": t.flat((60, 60, 66))}),
        cylinder(f"{name}/pole", (0.12, -0.2, 0.03), 0.02, 1.3, {"": t.flat((90, 88, 84))}),
        cylinder(f"{name}/shade", (0.12, -0.2, 1.33), 0.19, 0.3, {"": t.stripes(((238, 220, 180), (200, 120, 80), (120, 60, 50)), 0.1)}),
        cylinder(
            f"{name}/bin",
            (-0.22, -0.2, 0.0),
            0.14,
            0.36,
            {"": pick(rng, (p.mosaic, t.stripes(((70, 100, 120), (220, 220, 210), (230, 160, 60)), 0.06)))},
        ),
    ]
    return Piece(name, 0.75, 0.42, 1.63, solids)


def chair(name: str, rng: np.random.Generator) -> Piece:
    """Chair with a patterned seat and back."""
    colour, cloth = pick(rng, WOODS), {"": t.fabric(*pick(rng, FABRICS))}
    solids = [
        box(f"{name}/seat", (0.0, -0.24, 0.42), (0.44, 0.44, 0.06), cloth),
        box(f"{name}/back", (0.0, -0.03, 0.6), (0.42, 0.04, 0.35), cloth),
    ]
    for k, (x, y, h) in enumerate(((-0.19, -0.43, 0.42), (0.19, -0.43, 0.42), (-0.19, -0.03, 0.6), (0.19, -0.03, 0.6))):
        solids.append(box(f"{name}/leg_{k}", (x, y, 0.0), (0.04, 0.04, h), {"": t.wood(colour, along_x=False)}))
    return Piece(name, 0.46, 0.48, 0.95, solids)


def _on_top(name: str, rng: np.random.Generator, width: float, depth: float, height: float) -> list[Solid]:
    """Things on a flat top at `height`: mugs, parcels, piles of books."""
    solids = []
    n = int(rng.integers(2, 5))
    for k in range(n):
        x = -width / 2 + (k + rng.uniform(0.3, 0.7)) * width / n
        y = -rng.uniform(0.3, 0.7) * depth
        kind = rng.integers(3)
        if kind == 0:
            label = t.stripes((pick(rng, pick(rng, PALETTES)), PAPER, INK), 0.03)
            solids.append(cylinder(f"{name}/item_{k}", (x, y, height), rng.uniform(0.035, 0.07), rng.uniform(0.1, 0.25), {"": label}))
            continue
        size = (rng.uniform(0.12, 0.26), rng.uniform(0.1, 0.18), rng.uniform(0.06, 0.3))
        cover = p.books if kind == 1 else pick(rng, (p.cardboard, p.mosaic, p.notice))
        solids.append(box(f"{name}/item_{k}", (x, y, height), size, {"": cover}, yaw=rng.uniform(-0.5, 0.5)))
    return solids


ALONG_WALLS: tuple[Callable[[str, np.random.Generator], Piece], ...] = (
    bookcase, desk_with_screen, cabinet, sofa, plant, parcels, bin_and_lamp, table,
)  # fmt: skip
