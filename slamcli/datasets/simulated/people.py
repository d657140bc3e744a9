"""What people do in a simulated room: each activity is a walk planned around the camera's motion, so that it is seen.

Nobody minds the furniture: what of a figure is behind a surface of the room is not seen.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamcli.datasets.simulated import picture
from slamcli.datasets.simulated.drive import Motion
from slamcli.datasets.simulated.figures import BOX, CARRIED, STRIDE, BodyPart, Figure, Posture, dress, limbs, standing_at

RATE = 60.0  # [Hz] at which walks are planned
BRISK = 1.8  # [m/s] at most
SHY = 1.1  # [m] to the camera: nearer, and one who waits walks on
ARRIVED = 0.1  # [m]
WALL = 0.3  # [m] that hips keep from the walls
WAIT, GO = 2.6, 1.6  # [s] of standing or sitting, and of the walk to the next place
SIT_DOWN = 0.7  # [s]
SMOOTH = 0.25  # [s] of the window that walks and headings are smoothed over
PICK_UP = 0.8  # [s] from the floor into the hands

Ahead = Callable[[np.ndarray, np.ndarray | float], np.ndarray]  # stamps (N,), distance [m] -> places (N, 2) before the camera


@dataclass(frozen=True)
class Course:
    """The camera's way, as walks are planned on it."""

    t: np.ndarray  # (T,) [s] even stamps
    ahead: Ahead
    low: np.ndarray  # (2,) [m] corners of the floor
    high: np.ndarray  # (2,)


def populate(
    motion: Motion, low: np.ndarray, high: np.ndarray, *, people: int, activities: tuple[str, ...], drives: bool, seed: int
) -> list[Figure]:
    """Plan the walks of `people` figures, who take up `activities` in turn.

    low, high : (3,) [m] corners of the room
    drives : whether the camera follows a way, on which people walk before it; else they stay in its view
    """
    first = min(motion.colour_stamp[0], motion.depth_stamp[0])
    last = max(motion.colour_stamp[-1], motion.depth_stamp[-1])
    t = np.linspace(first, last, max(2, round((last - first) * RATE) + 1))
    course = Course(t, _on_the_way(motion) if drives else _in_view(motion), low[:2] + WALL, high[:2] - WALL)
    figures = []
    for k in range(people):
        rng = np.random.default_rng([seed, 5, k])
        figures += _person(f"person_{k}", activities[k % len(activities)], course, rng)
    return figures


def _person(name: str, activity: str, course: Course, rng: np.random.Generator) -> list[Figure]:
    """Plan one person's walk; with a box of its own where it carries one."""
    size, parts = rng.uniform(0.93, 1.07), dress(rng)
    xy, sitting, box = ACTIVITIES[activity](course, rng)
    xy = _smooth(np.clip(xy, course.low, course.high))
    step = np.gradient(xy, course.t, axis=0)
    speed = np.linalg.norm(step, axis=1)
    direction = _smooth(_last_direction(step, speed))
    heading = np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))
    phase = 2 * np.pi * np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(course.t))]) / STRIDE + rng.uniform(0, 6)
    vigour = np.clip(speed / 0.5, 0.0, 1.0)
    plan = np.column_stack([xy, heading, phase, vigour, sitting, box])

    def posture(stamp: np.ndarray) -> Posture:
        x, y, *rest = (np.interp(stamp, course.t, column) for column in plan.T)
        return Posture(np.column_stack([x, y]), *rest)

    def with_limbs(stamp: np.ndarray) -> np.ndarray:
        return limbs(posture(stamp), size)[:, : len(parts)]

    scaled = [BodyPart(part.name, part.kind, size * part.half, part.painter) for part in parts]
    found = [Figure(name, "person", scaled, with_limbs)]
    if box.any():
        found.append(Figure(f"{name}/box", "box", [BodyPart("box", BOX, CARRIED, picture.cardboard)], _carried(posture, course.t)))
    return found


def _carried(posture: Callable[[np.ndarray], Posture], t: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the pose of a box that stands on the floor before a person's feet until it is picked up, then goes along."""
    start = posture(t[:1])

    def pose(stamp: np.ndarray) -> np.ndarray:
        now = posture(stamp)
        here, there = standing_at(now.xy, now.heading), standing_at(start.xy, start.heading)
        held = np.clip(now.reach, 0.0, 1.0)
        T = np.where((held > 0.0)[:, None, None], here, there)
        offset = np.tile(np.eye(4), (len(stamp), 1, 1))
        offset[:, 0, 3], offset[:, 2, 3] = 0.48 - 0.08 * held, CARRIED[2] + 0.8 * held
        return (T @ offset)[:, None]

    return pose


def _beside(course: Course, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walk before the camera all the time, now nearer, now farther."""
    near = rng.uniform(0.85, 1.15)
    distance = near + 0.25 * np.sin(2 * np.pi * course.t / rng.uniform(5, 8) + rng.uniform(0, 6))
    aside = 0.25 * np.sin(2 * np.pi * course.t / rng.uniform(6, 9) + rng.uniform(0, 6))
    return _place(course, distance, aside), *_upright(course)


def _cross(course: Course, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walk to and fro through the view."""
    aside = 1.3 * np.sin(2 * np.pi * course.t / rng.uniform(5, 7) + rng.uniform(0, 6))
    return _place(course, rng.uniform(1.3, 1.9), aside), *_upright(course)


def _approach(course: Course, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Come towards the camera and go away from it."""
    distance = 1.9 + 1.0 * np.cos(2 * np.pi * course.t / rng.uniform(5, 7) + rng.uniform(0, 6))
    return _place(course, distance, rng.uniform(-0.4, 0.4)), *_upright(course)


def _stand(course: Course, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stand for a while, go on, and stand again."""
    xy, _ = _wait_and_go(course, rng)
    return xy, *_upright(course)


def _sit(course: Course, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sit for a while, rise, go on, and sit down again."""
    xy, waits = _wait_and_go(course, rng)
    return xy, _running_mean(waits[:, None].astype(np.float64), round(SIT_DOWN * RATE))[:, 0], np.zeros(len(course.t))


def _carry(course: Course, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stand by a box, pick it up and carry it along, with rests."""
    xy, waits = _wait_and_go(course, rng)
    leaves = np.inf if waits.all() else course.t[np.argmin(waits)]
    return xy, np.zeros(len(course.t)), np.clip((course.t - leaves + PICK_UP) / PICK_UP, 0.0, 1.0)


ACTIVITIES: dict[str, Callable[[Course, np.random.Generator], tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
    "beside": _beside, "cross": _cross, "stand": _stand, "approach": _approach, "sit": _sit, "carry": _carry,
}  # fmt: skip


def _upright(course: Course) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(len(course.t)), np.zeros(len(course.t))


def _place(course: Course, distance: np.ndarray | float, aside: np.ndarray | float, t: np.ndarray | None = None) -> np.ndarray:
    """Return places (N, 2) ahead of the camera and to the left of its way."""
    t = course.t if t is None else t
    here, beyond = course.ahead(t, distance), course.ahead(t, np.asarray(distance) + 0.1)
    along = beyond - here
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    left = np.column_stack([-along[:, 1], along[:, 0]])
    return here + np.broadcast_to(aside, len(t))[:, None] * left


def _wait_and_go(course: Course, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return places (T, 2) of waiting and of walking on in turn, and whether one waits (T,); nobody waits until the camera bumps into them."""
    distance, aside = rng.uniform(1.9, 2.5), rng.uniform(-0.35, 0.35)
    goal, camera = _place(course, distance, aside), course.ahead(course.t, 0.0)
    xy, waits = np.empty_like(goal), np.ones(len(course.t), dtype=bool)
    place, since, is_waiting = goal[0], course.t[0], True
    for i, t in enumerate(course.t):
        step = goal[i] - place
        if (is_waiting and (t - since >= WAIT or np.linalg.norm(place - camera[i]) < SHY)) or (
            not is_waiting and t - since >= GO and np.linalg.norm(step) < ARRIVED
        ):
            is_waiting, since = not is_waiting, t
        if not is_waiting:
            place = place + step * min(1.0, BRISK / RATE / max(float(np.linalg.norm(step)), 1e-9))
        xy[i], waits[i] = place, is_waiting
    return xy, waits


def _on_the_way(motion: Motion) -> Ahead:
    """Find places along the way that the camera will take; beyond its end, straight on."""
    way = motion.colour_T_lc[:, :2, 3]
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    behind = int(np.searchsorted(arc, arc[-1] - 0.3, side="right")) - 1
    last = way[-1] - way[max(behind, 0)]
    last = last / max(float(np.linalg.norm(last)), 1e-9) if last.any() else motion.colour_T_lc[-1, :2, 2]

    def ahead(t: np.ndarray, distance: np.ndarray | float) -> np.ndarray:
        s = np.interp(t, motion.colour_stamp, arc) + distance
        on = np.stack([np.interp(s, arc, way[:, k]) for k in range(2)], axis=1)
        return on + np.maximum(s - arc[-1], 0.0)[:, None] * last

    return ahead


def _in_view(motion: Motion) -> Ahead:
    """Find places before a camera that may turn about; quick turns of it are not followed."""
    xy, view = motion.colour_T_lc[:, :2, 3], motion.colour_T_lc[:, :2, 2]
    seconds = (motion.colour_stamp[-1] - motion.colour_stamp[0]) / max(len(xy) - 1, 1)
    window = max(1, round(1.0 / max(seconds, 1e-3)))
    xy, view = _running_mean(xy, window), _running_mean(view, window)
    view = view / np.maximum(np.linalg.norm(view, axis=1), 1e-9)[:, None]

    def ahead(t: np.ndarray, distance: np.ndarray | float) -> np.ndarray:
        at = np.stack([np.interp(t, motion.colour_stamp, xy[:, k]) for k in range(2)], axis=1)
        to = np.stack([np.interp(t, motion.colour_stamp, view[:, k]) for k in range(2)], axis=1)
        return at + np.broadcast_to(distance, len(t))[:, None] * to

    return ahead


def _last_direction(step: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the direction (N, 2) of each step, of a rest that of the step before it."""
    moves = speed > 0.05
    first = int(np.argmax(moves)) if moves.any() else 0
    index = np.maximum.accumulate(np.where(moves, np.arange(len(speed)), first))
    return step[index] / np.maximum(speed[index], 1e-9)[:, None] if moves.any() else np.tile([1.0, 0.0], (len(speed), 1))


def _smooth(values: np.ndarray) -> np.ndarray:
    return _running_mean(_running_mean(values, round(SMOOTH * RATE)), round(SMOOTH * RATE))


def _running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Average (N, k) over `window` rows, those at the ends repeated beyond them."""
    before = window // 2
    padded = np.concatenate([values[:1].repeat(before, axis=0), values, values[-1:].repeat(window - before, axis=0)])
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(padded, axis=0)])
    return (total[window:] - total[:-window])[: len(values)] / window
