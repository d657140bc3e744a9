"""Things of a simulated room that move: a door that swings open in view, and a chair that stands elsewhere at the next visit."""

from dataclasses import dataclass, replace

import numpy as np

from slamcli.datasets.simulated import furniture, picture
from slamcli.datasets.simulated.brush import pick
from slamcli.datasets.simulated.drive import Motion
from slamcli.datasets.simulated.figures import BOX, BodyPart, Figure, standing_at
from slamcli.datasets.simulated.scene import Doorway, Solid, box
from slamcli.geometry.algebra import product

OPENS_BY = 1.4  # [rad]
OPENS_IN = 2.0  # [s]
LEAF = 0.04  # [m] thickness of a door
BEFORE_WALL = 0.05  # [m] from the wall to the middle of the closed leaf
SEEN_UP_TO, SEEN_ASIDE = 4.0, 0.4  # [m] from the camera, and of the depth to either side: what is in view
FLOOR_GAP = 0.02  # [m] below a door


@dataclass(frozen=True)
class Moved:
    """Something that moves, and what it is when all is over."""

    figure: Figure
    last: list[Solid]


def seconds_in_view(doorway: Doorway, motion: Motion) -> float:
    """Return how long the camera looks at a doorway."""
    step = np.median(np.diff(motion.colour_stamp)) if len(motion.colour_stamp) > 1 else 0.0
    return float(step * _is_in_view(motion, _middle(doorway)).sum())


def door(doorway: Doorway, motion: Motion, rng: np.random.Generator) -> Moved:
    """Hang a door into a doorway: it opens in the middle of the longest time that the camera looks at it, and stays open."""
    along, inward = doorway.along, np.array([doorway.along[1], -doorway.along[0]])
    hinge = doorway.left + BEFORE_WALL * inward
    opens = _middle_of_longest(motion.colour_stamp, _is_in_view(motion, _middle(doorway)))
    size = np.array([doorway.width, LEAF, doorway.height - FLOOR_GAP])
    closed_yaw = float(np.arctan2(along[1], along[0]))

    def yaw(stamp: np.ndarray) -> np.ndarray:
        share = np.clip((stamp - opens) / OPENS_IN + 0.5, 0.0, 1.0)
        return closed_yaw - OPENS_BY * (0.5 - 0.5 * np.cos(np.pi * share))

    def centre(angle: np.ndarray) -> np.ndarray:
        return hinge + 0.5 * doorway.width * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def pose(stamp: np.ndarray) -> np.ndarray:
        angle = yaw(stamp)
        middle = np.column_stack([centre(angle), np.full(len(stamp), FLOOR_GAP + 0.5 * size[2])])
        return _upright(middle, angle)[:, None]

    leaf = BodyPart("leaf", BOX, 0.5 * size, picture.door(pick(rng, furniture.WOODS)))
    last = float(yaw(motion.colour_stamp[-1:])[0])
    place = [*centre(np.array(last)), FLOOR_GAP]
    return Moved(Figure("door", "door", [leaf], pose), [box("door", place, size, {"": leaf.painter}, yaw=last)])


def chair(places: tuple[list[Solid], ...], motion: Motion) -> Moved:
    """Let a chair stand where it is in view longest in the first half, and elsewhere, where it is in the second, from a moment unseen on.

    places : its parts in each place, in one order. The moment is one in which neither place is in view, as near to half-way as there is one
    """
    stamp, half = motion.colour_stamp, len(motion.colour_stamp) // 2
    seen = np.array([_is_in_view(motion, np.mean([solid.centre for solid in solids], axis=0)) for solids in places])
    first = int(np.argmax(seen[:, :half].sum(axis=1)))
    then = int(np.argmax(np.where(np.arange(len(places)) == first, -1, seen[:, half:].sum(axis=1))))
    is_seen = seen[first] | seen[then]
    from_half = np.abs(stamp - 0.5 * (stamp[0] + stamp[-1])) + np.where(is_seen, stamp[-1] - stamp[0] + 1.0, 0.0)
    moves = stamp[np.argmin(from_half)]
    placed = [_upright(np.array([s.centre for s in solids]), np.array([s.yaw for s in solids])) for solids in (places[first], places[then])]

    def pose(stamp: np.ndarray) -> np.ndarray:
        return np.where((stamp < moves)[:, None, None, None], placed[0], placed[1])

    parts = [BodyPart(solid.name, BOX, 0.5 * solid.size, solid.painters[""]) for solid in places[first]]
    return Moved(Figure("chair", "chair", parts, pose), [replace(solid, name=f"moved_{solid.name}") for solid in places[then]])


def _middle(doorway: Doorway) -> np.ndarray:
    return np.array([*(doorway.left + 0.5 * doorway.width * doorway.along), 0.5 * doorway.height])


def _upright(centre: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) in the level frame of things that stand upright, turned by `yaw` (N,)."""
    T = standing_at(centre[:, :2], yaw)
    T[:, 2, 3] = centre[:, 2]
    return T


def _is_in_view(motion: Motion, x: np.ndarray) -> np.ndarray:
    """Say of each colour image (F,) whether a point of the level frame is well within its view; walls and furniture hide nothing."""
    T_lc = motion.colour_T_lc
    x_c = product((x - T_lc[:, :3, 3])[:, None, :], T_lc[:, :3, :3])[:, 0]
    depth = x_c[:, 2]
    return (depth > 0.5) & (depth < SEEN_UP_TO) & (np.abs(x_c[:, 0]) < SEEN_ASIDE * depth)


def _middle_of_longest(stamp: np.ndarray, is_so: np.ndarray) -> float:
    """Return the stamp in the middle of the longest stretch in which something is so; half-way where it never is."""
    edge = np.flatnonzero(np.diff(np.concatenate([[False], is_so, [False]]).astype(np.int8)))
    first, end = edge[::2], edge[1::2]
    if not len(first):
        return float(0.5 * (stamp[0] + stamp[-1]))
    k = int(np.argmax(end - first))
    return float(0.5 * (stamp[first[k]] + stamp[end[k] - 1]))
