"""What a simulated room is made of: solids for the list of obstacles, flat textured patches for the renderer.

Level frame: x and y span the floor, z points up, the floor is z = 0.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from slamcli.datasets.simulated import texture
from slamcli.datasets.simulated.brush import Painter

FACETS = 20  # of a cylinder
SIDES = ("front", "back", "left", "right", "top", "bottom")


@dataclass(frozen=True)
class Patch:
    """A flat convex polygon with a picture on it.

    A point x of its plane sees the picture at the shares ((x - origin) . a / |a|^2, (x - origin) . b / |b|^2) of its width and height.
    """

    polygon: np.ndarray  # (k, 3) corners, counter-clockwise seen from outside
    origin: np.ndarray  # (3,) upper left corner of the picture
    a: np.ndarray  # (3,) from there to its upper right corner
    b: np.ndarray  # (3,) to its lower left corner; a x b points inwards
    painter: Painter
    key: tuple[str, str]  # names of solid and side: the seed of the picture
    columns: tuple[float, float] = (0.0, 1.0)  # share of a wider picture's columns that this patch shows
    picture_width: float = 0.0  # [m] of that wider picture, 0 = |a|
    is_movable: bool = False


@dataclass(frozen=True)
class Solid:
    """A box or an upright cylinder."""

    name: str
    kind: str  # "box" or "cylinder"
    centre: np.ndarray  # (3,) [m]
    size: np.ndarray  # (3,) [m] along its own axes; a cylinder's is (2 r, 2 r, height)
    yaw: float  # [rad] about z
    painters: dict[str, Painter]  # by side, "" = all others
    is_movable: bool = False
    shared: dict[str, str] = field(default_factory=dict)  # by side, whose picture it shows: of one name, all look alike

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of scene.json."""
        shape: dict[str, Any] = {"size": _rounded(self.size), "yaw": round(float(self.yaw), 9)}
        if self.kind == "cylinder":
            shape = {"radius": round(float(self.size[0] / 2), 9), "height": round(float(self.size[2]), 9)}
        return {"name": self.name, "type": self.kind, "centre": _rounded(self.centre), **shape}

    def patches(self) -> list[Patch]:
        """Return its faces; a bottom that stands on the floor is left out."""
        return self._box() if self.kind == "box" else self._cylinder()

    def _painter(self, side: str) -> Painter:
        return self.painters.get(side, self.painters[""])

    def _box(self) -> list[Patch]:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        x, y, z = np.eye(3)
        # per side: outward normal and the direction that runs to the right in its picture
        frames = {"front": (-y, x), "back": (y, -x), "left": (-x, -y), "right": (x, y), "top": (z, x), "bottom": (-z, x)}
        patches = []
        for side in SIDES:
            normal, right = frames[side]
            if side == "bottom" and self.centre[2] - self.size[2] / 2 < 1e-6:
                continue
            down = -np.cross(normal, right)
            origin = self.centre + R @ (0.5 * self.size * (normal - right - down))
            patches.append(rectangle(origin, R @ (self.size * right), R @ (self.size * down), self._painter(side), (self.shared.get(side, self.name), side),
                                     is_movable=self.is_movable))  # fmt: skip
        return patches

    def _cylinder(self) -> list[Patch]:
        radius, height = self.size[0] / 2, self.size[2]
        angle = 2.0 * np.pi * np.arange(FACETS + 1) / FACETS
        rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(FACETS + 1)], axis=1) * radius + self.centre
        up = np.array([0.0, 0.0, height / 2])
        patches = [
            rectangle(rim[i] + up, rim[i + 1] - rim[i], -2 * up, self._painter("side"), (self.name, "side"), is_movable=self.is_movable,
                      columns=(i / FACETS, (i + 1) / FACETS), picture_width=2 * np.pi * radius)
            for i in range(FACETS)
        ]  # fmt: skip
        corner = self.centre + up + np.array([-radius, radius, 0.0])
        a, b = np.array([2 * radius, 0.0, 0.0]), np.array([0.0, -2 * radius, 0.0])
        patches.append(Patch(rim[:-1] + up, corner, a, b, self._painter("top"), (self.name, "top"), is_movable=self.is_movable))
        if self.centre[2] - height / 2 > 1e-6:
            patches.append(Patch(rim[-2::-1] - up, corner - 2 * up - b * -1.0, a, -b, self._painter("bottom"), (self.name, "bottom"),
                                 is_movable=self.is_movable))  # fmt: skip
        return patches


@dataclass(frozen=True)
class Doorway:
    """A door in a wall, as seen from inside the room."""

    left: np.ndarray  # (2,) [m] its left end on the wall
    along: np.ndarray  # (2,) unit, to its right end
    width: float  # [m]
    height: float  # [m]


@dataclass(frozen=True)
class Scene:
    """A furnished room."""

    low: np.ndarray  # (3,) [m] corner of the room with the smallest coordinates, z = 0
    high: np.ndarray  # (3,) [m] the opposite corner
    solids: list[Solid]
    shell: list[Patch]  # floor, walls, ceiling
    lamps: np.ndarray  # (n, 3) [m] centres of the square ceiling lamps
    seed: int
    doorways: tuple[Doorway, ...] = ()
    chair_places: tuple[list[Solid], ...] = ()  # where a chair that is moved may stand, its parts in each; it is none of the solids

    def patches(self) -> list[Patch]:
        """Return every patch, the room's own first."""
        return self.shell + [patch for solid in self.solids for patch in solid.patches()]

    def to_dict(self) -> dict[str, Any]:
        """Return the room's part of scene.json."""
        return {
            "room": {"min": _rounded(self.low), "max": _rounded(self.high)},
            "obstacles": [solid.to_dict() for solid in self.solids],
        }


def rectangle(origin: np.ndarray, a: np.ndarray, b: np.ndarray, painter: Painter, key: tuple[str, str], **more: Any) -> Patch:
    """Make a rectangular patch from its upper left corner and its edges to the right (a) and down (b)."""
    polygon = np.array([origin, origin + b, origin + a + b, origin + a])
    return Patch(polygon, origin, a, b, painter, key, **more)


def box(name: str, centre: Any, size: Any, painters: dict[str, Painter], *, yaw: float = 0.0, is_movable: bool = False) -> Solid:
    """Make a box from the centre of its bottom and its size."""
    centre, size = np.array(centre, dtype=np.float64), np.array(size, dtype=np.float64)
    return Solid(name, "box", centre + [0.0, 0.0, size[2] / 2], size, yaw, painters, is_movable)


def cylinder(name: str, centre: Any, radius: float, height: float, painters: dict[str, Painter]) -> Solid:
    """Make an upright cylinder from the centre of its bottom."""
    centre = np.array(centre, dtype=np.float64) + [0.0, 0.0, height / 2]
    return Solid(name, "cylinder", centre, np.array([2 * radius, 2 * radius, height]), 0.0, painters)


def room_shell(
    low: np.ndarray, high: np.ndarray, walls: dict[str, Painter], floor: Painter, ceiling: Painter, *, twins: tuple[str, ...] = ()
) -> list[Patch]:
    """Make floor, ceiling and the walls south (y = low), north, west (x = low), east, seen from inside.

    twins : of "north" and "west", those that show the same picture as the wall opposite; they must be given its painter
    """
    (x0, y0, z0), (x1, y1, z1) = low, high
    dx, dy, dz = np.diag(high - low)
    sides = {
        "floor": ((x0, y1, z0), dx, -dy, floor),
        "ceiling": ((x0, y0, z1), dx, dy, ceiling),
        "south": ((x1, y0, z1), -dx, -dz, walls["south"]),
        "north": ((x0, y1, z1), dx, -dz, walls["north"]),
        "west": ((x0, y0, z1), dy, -dz, walls["west"]),
        "east": ((x1, y1, z1), -dy, -dz, walls["east"]),
    }
    picture_of = {name: opposite for name, opposite in (("north", "south"), ("west", "east")) if name in twins}
    return [rectangle(np.array(o), a, b, painter, ("room", picture_of.get(side, side))) for side, (o, a, b, painter) in sides.items()]


def with_textured_share(patches: list[Patch], share: float, seed: int) -> list[Patch]:
    """Leave pictures to a share of the objects and walls; the others keep their mean colour and show shading only."""
    owner = ["/".join(patch.key) if patch.key[0] == "room" else patch.key[0].split("/")[0] for patch in patches]
    names = sorted(set(owner))
    keeps = dict(zip(names, np.random.default_rng([seed, 1]).random(len(names)) < share, strict=True))
    return [
        patch if keeps[name] else replace(patch, painter=texture.untextured(patch.painter))
        for name, patch in zip(owner, patches, strict=True)
    ]  # fmt: skip


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(value), 9) for value in values]
