"""Furnish a simulated room: paint, pictures, furniture along the walls, an island in the middle, a hanging box and a low box."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamcli.datasets.simulated import furniture
from slamcli.datasets.simulated import picture as p
from slamcli.datasets.simulated import texture as t
from slamcli.datasets.simulated.brush import Painter, pick
from slamcli.datasets.simulated.furniture import Piece
from slamcli.datasets.simulated.scene import Doorway, Scene, Solid, box, cylinder, room_shell
from slamcli.errors import SlamError

HEIGHT = 2.6  # [m] of the ceiling
CLEARANCE = 0.35  # [m] between the camera's path and anything
LOW_BOX = np.array([0.5, 0.3, 0.12])
HANGING_BOX = np.array([0.5, 0.35, 0.3])
HANGING_AT = 0.3  # [m] above the floor: a planar laser at robot height looks underneath
CORRIDOR_PITCH = 2.0  # [m] from door to door
CHAIR_PLACES, CHAIR_TO_PATH = 12, 1.2  # that are looked for; [m] to the camera's path at most
DOOR, BEFORE_DOOR = (0.95, 2.1), 0.5  # [m] width and height; floor that stays free before it
WALL_COLOURS = ((236, 226, 205), (204, 220, 224), (228, 206, 190), (214, 222, 196), (226, 218, 232))

# Walls by name: start (as seen from inside, left end), direction to the right, turn of furniture standing at them [rad]
WALL_FRAMES = {
    "south": (np.array([1, 0]), np.array([-1, 0]), np.pi),
    "north": (np.array([0, 1]), np.array([1, 0]), 0.0),
    "west": (np.array([0, 0]), np.array([0, 1]), np.pi / 2),
    "east": (np.array([1, 1]), np.array([0, -1]), -np.pi / 2),
}


@dataclass(frozen=True)
class Furnishing:
    """What a room is furnished with."""

    twin: int = 0  # another number is another room with the same patterns and the same kinds of pieces
    twin_walls: bool = False  # opposite walls look the same
    movable: bool = False  # a large parcel beside the path, marked as movable
    empty: bool = False  # with nothing
    moved_chair: bool = False  # places for a chair beside the path


@dataclass(frozen=True)
class Where:
    """Where a piece may stand."""

    near: np.ndarray | None = None  # (2,) [m]; None = anywhere
    spread: float = 0.0  # [m] from `near` along each axis
    clearance: float = CLEARANCE  # [m] between it and the camera's path
    most: float = np.inf  # [m] the same, at most
    gap: float = 0.3  # [m] between it and other pieces


def furnished_room(low: np.ndarray, high: np.ndarray, path: np.ndarray, *, seed: int, furnishing: Furnishing) -> Scene:
    """Furnish a room so that the camera's path never comes near an object.

    low, high : (3,) [m] corners of the room
    path : (N, 3) [m] camera centres
    """
    twin, twins = furnishing.twin, furnishing.twin_walls
    rng = np.random.default_rng([seed, 0, *([twin] if twin else [])])
    free = FreeSpace(low, high, path)
    walls, doorways = _paint_walls(low, high, rng, twins)
    for doorway in doorways:
        free.take(_floor_before(doorway))
    solids: list[Solid] = []
    if not furnishing.empty:
        _special_boxes(solids, free, rng, high[2], furnishing.movable)
        _island(solids, free, rng)
        along_walls(solids, free, rng)
        _scatter(solids, free, rng)
    chair_places = _places_of_a_chair(free, np.random.default_rng([seed, 7])) if furnishing.moved_chair else ()
    lamps = _lamps(low, high)
    base = pick(rng, (t.planks((196, 150, 100)), t.planks((150, 106, 72)), t.tiles((206, 198, 184)), t.planks((214, 186, 146))))
    floor = p.floor(base, _rugs(low, high, rng))
    lamp_places = tuple((float(x - low[0]), float(y - low[1])) for x, y, _ in lamps)
    shell = room_shell(low, high, walls, floor, p.ceiling(lamp_places), twins=("north", "west") if twins else ())
    return Scene(low, high, solids, shell, lamps, seed, tuple(doorways), chair_places)


def corridor(low: np.ndarray, high: np.ndarray, *, seed: int, twin: int = 0) -> Scene:
    """Make a corridor in which every door, floor tile and lamp looks like the next; only the ends differ.

    twin : another number is another corridor that differs at its ends alone
    """
    rng = np.random.default_rng([seed, 0])
    items = (
        (0.35, 0.5, 0.9, high[2] - 0.5, p.door((150, 110, 80), "OFFICE")),
        (1.4, 0.9, 0.45, 0.6, p.notice),
        (1.45, 1.7, 0.3, 0.3, p.mosaic),
    )
    side = t.repeated(p.wall(t.plaster(pick(rng, WALL_COLOURS)), items), CORRIDOR_PITCH)
    width = float(high[1] - low[1])
    rng = np.random.default_rng([seed, 0, twin]) if twin else rng
    east, west = (wall_items(width, high[2], rng, []) for _ in range(2))
    walls = {"south": side, "north": side, "east": p.wall(t.brick((180, 96, 76)), east), "west": p.wall(t.plaster((150, 180, 200)), west)}
    floor = t.repeated(t.tiles((206, 198, 184), 0.25), CORRIDOR_PITCH)
    ceiling = t.repeated(p.ceiling(((CORRIDOR_PITCH / 2, width / 2),)), CORRIDOR_PITCH)
    shell = room_shell(low, high, walls, floor, ceiling, twins=("north",))
    middles = low[0] + CORRIDOR_PITCH * (0.5 + np.arange(round((high[0] - low[0]) / CORRIDOR_PITCH)))
    lamps = np.array([[x, low[1] + width / 2, high[2]] for x in middles])
    return Scene(low, high, [], shell, lamps, seed)


class FreeSpace:
    """Where something can still stand: axis-parallel rectangles taken so far, and the camera's path."""

    def __init__(self, low: np.ndarray, high: np.ndarray, path: np.ndarray) -> None:
        self.low, self.high = low[:2], high[:2]
        self._taken: list[tuple[np.ndarray, np.ndarray]] = []
        self._path = path[:: max(1, len(path) // 3000)]

    def take(self, rect: tuple[np.ndarray, np.ndarray]) -> None:
        """Mark a rectangle as taken."""
        self._taken.append(rect)

    def distance_to_path(self, rect: tuple[np.ndarray, np.ndarray], top: float) -> float:
        """Return the plan distance [m] from a rectangle to the part of the path that passes below `top` + clearance."""
        below = self._path[self._path[:, 2] < top + CLEARANCE][:, :2]
        if len(below) == 0:
            return np.inf
        outside = np.maximum(np.maximum(rect[0] - below, below - rect[1]), 0.0)
        return float(np.linalg.norm(outside, axis=1).min())

    def fits(self, rect: tuple[np.ndarray, np.ndarray], top: float, *, gap: float = 0.05, clearance: float = CLEARANCE) -> bool:
        """Say whether a rectangle is within the room, apart from everything taken, and clear of the path."""
        if (rect[0] < self.low - 1e-9).any() or (rect[1] > self.high + 1e-9).any():
            return False
        for other in self._taken:
            if (rect[0] < other[1] + gap).all() and (rect[1] > other[0] - gap).all():
                return False
        return self.distance_to_path(rect, top) > clearance


def _lamps(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    counts = [max(1, round((b - a) / 2.6)) for a, b in zip(low[:2], high[:2], strict=True)]
    axes = [a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low[:2], high[:2], counts, strict=True)]
    x, y = np.meshgrid(*axes, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, high[2])])


def _rugs(low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> tuple[tuple[float, float, float, float], ...]:
    """Return rugs (x, y, width, height) in the floor picture's metres."""
    size = high[:2] - low[:2]
    rugs = []
    for _ in range(max(1, int(size[0] * size[1] / 14))):
        w, h = rng.uniform(1.0, 1.8), rng.uniform(0.8, 1.3)
        rugs.append((rng.uniform(0.3, size[0] - w - 0.3), rng.uniform(0.3, size[1] - h - 0.3), w, h))
    return tuple(rugs)


def _paint_walls(low: np.ndarray, high: np.ndarray, rng: np.random.Generator, twins: bool) -> tuple[dict[str, Painter], list[Doorway]]:
    """Return the walls' painters, and the doors in them."""
    bases = [t.brick((182, 98, 78)), t.stripes(((222, 214, 196), (206, 196, 174), (150, 128, 110)), 0.3)]
    bases += [t.plaster(pick(rng, WALL_COLOURS)) for _ in range(2)]
    order = rng.permutation(4)
    walls, doorways = {}, []
    for number, (name, (start, right, _)) in enumerate(WALL_FRAMES.items()):
        length = float(abs((high - low)[:2] @ right))
        has_door = name in ("south", "east")
        door_at = rng.uniform(0.3, 0.6) * length
        items: list = []
        if has_door:
            width, height = DOOR
            items.append((door_at, high[2] - height, width, height, p.door(pick(rng, furniture.WOODS))))
            doorways.append(Doorway(low[:2] + start * (high - low)[:2] + right * door_at, right, width, height))
        items += wall_items(length, high[2], rng, [(door_at, door_at + DOOR[0])] if has_door else [])
        walls[name] = p.wall(bases[order[number]], tuple(items))
    if twins:
        walls["north"], walls["west"] = walls["south"], walls["east"]
    return walls, doorways


def _floor_before(doorway: Doorway) -> tuple[np.ndarray, np.ndarray]:
    """Return the floor before a door, which stays free."""
    inward = np.array([doorway.along[1], -doorway.along[0]])
    a, b = doorway.left, doorway.left + doorway.along * doorway.width + inward * BEFORE_DOOR
    return np.minimum(a, b), np.maximum(a, b)


def wall_items(length: float, height: float, rng: np.random.Generator, taken: list[tuple[float, float]]) -> tuple:
    """Hang pictures in columns of one to three, and now and then a window."""
    items = []
    x = rng.uniform(0.1, 0.3)
    while x < length - 0.3:
        is_window = rng.random() < 0.12
        w = rng.uniform(1.0, 1.3) if is_window else rng.uniform(0.3, 0.85)
        if any(x < b + 0.1 and x + w > a - 0.1 for a, b in taken) or x + w > length - 0.1:
            x += 0.15
            continue
        if is_window:
            items.append((x, height - 2.1, w, 1.2, p.window))
            items.append((x + 0.1, height - 0.75, 0.5, 0.4, pick(rng, p.PICTURES)))
        else:
            y = height - rng.uniform(2.0, 2.3)
            while y < height - 0.45:
                h = min(rng.uniform(0.35, 0.85), height - 0.2 - y)
                if h > 0.2:
                    items.append((x, y, w * rng.uniform(0.8, 1.0), h, pick(rng, p.PICTURES)))
                y += h + rng.uniform(0.06, 0.35)
        x += w + rng.uniform(0.06, 0.4)
    return tuple(items)


def _rect(x: float, y: float, yaw: float, piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """Return the footprint of a piece that stands parallel to the walls."""
    c, s = np.cos(yaw), np.sin(yaw)
    local = np.array([[-piece.width / 2, 0.0], [piece.width / 2, -piece.depth]])
    corners = local @ np.array([[c, s], [-s, c]]) + [x, y]
    return corners.min(axis=0), corners.max(axis=0)


def along_walls(solids: list[Solid], free: FreeSpace, rng: np.random.Generator) -> None:
    """Line the walls with furniture, as varied as possible."""
    makers = list(furniture.ALONG_WALLS)
    count = 0
    for start, right, yaw in WALL_FRAMES.values():
        size = free.high - free.low
        length = abs(size @ right)
        x = rng.uniform(0.05, 0.4)
        while x < length - 0.4:
            if not makers:
                makers = list(furniture.ALONG_WALLS)
            maker = makers[int(rng.integers(len(makers)))]
            piece = maker(f"{maker.__name__}_{count}", rng)
            middle = free.low + start * size + right * (x + piece.width / 2) - np.array([-right[1], right[0]]) * 0.01
            rect = _rect(middle[0], middle[1], yaw, piece)
            if x + piece.width < length and free.fits(rect, piece.height):
                free.take(rect)
                solids += piece.at(middle[0], middle[1], yaw)
                makers.remove(maker)
                count += 1
                x += piece.width + rng.uniform(0.05, 0.7)
            else:
                x += 0.2


def _place_freely(
    piece: Piece, solids: list[Solid], free: FreeSpace, rng: np.random.Generator, where: Where, *, attempts: int = 300
) -> bool:
    """Put a piece at a random place, turned by a multiple of a right angle, and say whether there was one."""
    for _ in range(attempts):
        yaw = np.pi / 2 * rng.integers(4)
        xy = rng.uniform(free.low, free.high) if where.near is None else where.near + rng.uniform(-where.spread, where.spread, 2)
        rect = _rect(xy[0], xy[1], yaw, piece)
        fits = free.fits(rect, piece.height, gap=where.gap, clearance=where.clearance)
        if fits and free.distance_to_path(rect, piece.height) <= where.most:
            free.take(rect)
            solids += piece.at(xy[0], xy[1], yaw)
            return True
    return False


def _special_boxes(solids: list[Solid], free: FreeSpace, rng: np.random.Generator, ceiling: float, movable: bool) -> None:
    """Place the two boxes of [L] section 4, which decide whether a map is fit for driving, near the path so that they are seen."""
    w, d, h = HANGING_BOX
    hanging = box("hanging_box", (0.0, -d / 2, HANGING_AT), HANGING_BOX, {"": p.mosaic, "top": p.cardboard})
    string = cylinder("hanging_box/string", (0.0, -d / 2, HANGING_AT + h), 0.004, ceiling - HANGING_AT - h, {"": t.flat((60, 60, 60))})
    pieces = [Piece("hanging_box", w, d, ceiling, [hanging, string])]
    w, d, h = LOW_BOX
    pieces.append(Piece("low_box", w, d, h, [box("low_box", (0.0, -d / 2, 0.0), LOW_BOX, {"": p.notice, "top": p.shapes})]))
    if movable:
        parcel = box("moved_box", (0.0, -0.25, 0.0), (0.55, 0.5, 0.55), {"": p.cardboard, "top": p.mosaic}, is_movable=True)
        pieces.append(Piece("moved_box", 0.55, 0.5, 0.55, [parcel]))
    for piece in pieces:
        # A low box lies where the robot would drive over it, a hanging one where it would drive under it: beside the path, never on it.
        places = (Where(clearance=0.3, most=most, gap=0.35) for most in (0.8, 1.5, np.inf))
        if not any(_place_freely(piece, solids, free, rng, where) for where in places):
            raise SlamError(f"simulated room: no place for the {piece.name} beside this path; try another seed or a larger room")


def _places_of_a_chair(free: FreeSpace, rng: np.random.Generator) -> tuple[list[Solid], ...]:
    """Find places for a chair beside the path, apart from each other; SlamError where there is one at most."""
    piece = furniture.chair("chair_moved", rng)
    places = list[list[Solid]]()
    for _ in range(CHAIR_PLACES):
        solids = list[Solid]()
        if _place_freely(piece, solids, free, rng, Where(most=CHAIR_TO_PATH, gap=0.1)):
            places.append(solids)
    if len(places) < 2:
        raise SlamError("simulated room: no two places for a chair beside this path; try another seed or a larger room")
    return tuple(places)


def _island(solids: list[Solid], free: FreeSpace, rng: np.random.Generator) -> None:
    """Put a table with chairs into the middle, if the path leaves room for it."""
    centre = (free.low + free.high) / 2
    piece = furniture.table("island", rng, width=rng.uniform(1.5, 1.9), depth=0.75)
    if not _place_freely(piece, solids, free, rng, Where(near=centre, spread=0.9, clearance=0.45)):
        return
    for k in range(2):
        chair = furniture.chair(f"chair_{k}", rng)
        _place_freely(chair, solids, free, rng, Where(near=centre, spread=1.6, gap=0.05), attempts=60)


def _scatter(solids: list[Solid], free: FreeSpace, rng: np.random.Generator) -> None:
    """Put single pieces on what is still a wide empty floor; small rooms get none."""
    area = float(np.prod(free.high - free.low))
    makers: tuple[Callable[[str, np.random.Generator], Piece], ...] = (
        furniture.parcels,
        furniture.table,
        furniture.plant,
        furniture.bookcase,
    )
    for k in range(int(max(0.0, area - 40.0) / 6.0)):
        piece = makers[k % len(makers)](f"scattered_{k}", rng)
        _place_freely(piece, solids, free, rng, Where(clearance=0.6, gap=0.6), attempts=60)
