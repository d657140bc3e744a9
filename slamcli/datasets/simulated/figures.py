"""People of a simulated room: ellipsoids and boxes with pictures on them, moved by joints that swing, bend and sit down."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamcli.datasets.simulated import picture as p
from slamcli.datasets.simulated import texture as t
from slamcli.datasets.simulated.brush import PALETTES, Painter, pick

ELLIPSOID, BOX = 0, 1  # kinds of parts
THIGH, SHIN, FOOT = 0.43, 0.42, 0.05  # [m] lengths of a leg, and the height of the ankle
UPPER_ARM, FOREARM = 0.29, 0.27  # [m]
SHOULDER = np.array([0.0, 0.21, 0.48])  # [m] from the middle of the hips: forward, left, up
HIP_WIDTH = 0.09  # [m] from the middle to one hip
STRIDE = 1.3  # [m] walked in a full cycle of both legs
LEG_SWING, ARM_SWING = 0.45, 0.5  # [rad] at a walk
KNEE_BEND = 0.9  # [rad] of the leg that swings forward
COATS = 0.5  # share of the people in long coats
SKIN = ((232, 190, 160), (198, 142, 104), (140, 92, 66), (96, 62, 46))
HAIR = ((44, 34, 30), (112, 78, 48), (190, 160, 110), (150, 150, 150))
CARRIED = np.array([0.2, 0.27, 0.17])  # [m] half the sides of the box that is carried


@dataclass(frozen=True)
class BodyPart:
    """One rigid part of a figure."""

    name: str
    kind: int  # ELLIPSOID or BOX
    half: np.ndarray  # (3,) [m] half axes: forward, left, up
    painter: Painter


@dataclass(frozen=True)
class Posture:
    """What N moments of a figure look like; each field (N, ...)."""

    xy: np.ndarray  # (N, 2) [m] level frame, of the middle of the hips
    heading: np.ndarray  # (N,) [rad]
    phase: np.ndarray  # (N,) [rad] of the gait
    vigour: np.ndarray  # (N,) 0 standing .. 1 walking
    sitting: np.ndarray  # (N,) 0 upright .. 1 seated
    reach: np.ndarray  # (N,) 0 arms swing .. 1 both are held out in front


@dataclass(frozen=True)
class Figure:
    """Somebody or something that moves: its parts and how they lie at any moment."""

    name: str
    kind: str  # "person" or "box"
    parts: list[BodyPart]
    pose: Callable[[np.ndarray], np.ndarray]  # stamps (N,) -> T_lp (N, parts, 4, 4), part to level frame


def dress(rng: np.random.Generator) -> list[BodyPart]:
    """Draw a person's clothes; the parts are in the order of `limbs`, the last of which not everybody wears."""
    palette = pick(rng, PALETTES)
    shirt = pick(rng, (p.shapes, p.mosaic, t.stripes((palette[0], palette[2], palette[4]), 0.09), t.fabric(palette[3], palette[1])))
    trousers = pick(rng, (t.fabric(palette[4], palette[2]), t.stripes((palette[4], palette[3], palette[2]), 0.12), p.mosaic, p.shapes))
    skin, hair = t.plaster(pick(rng, SKIN)), t.wood(pick(rng, HAIR), 20.0)
    shoe = t.fabric((40, 40, 44), palette[2])

    def part(name: str, half: tuple[float, float, float], painter: Painter) -> BodyPart:
        return BodyPart(name, ELLIPSOID, np.array(half), painter)

    both = [
        [part(f"{side}_thigh", (0.085, 0.085, 0.25), trousers), part(f"{side}_shin", (0.06, 0.06, 0.24), trousers),
         part(f"{side}_foot", (0.13, 0.05, 0.05), shoe), part(f"{side}_upper_arm", (0.05, 0.05, 0.17), shirt),
         part(f"{side}_forearm", (0.04, 0.04, 0.16), skin), part(f"{side}_hand", (0.03, 0.04, 0.08), skin)]
        for side in ("left", "right")
    ]  # fmt: skip
    body = [part("pelvis", (0.12, 0.17, 0.14), trousers), part("torso", (0.13, 0.2, 0.33), shirt)]
    head = [part("head", (0.1, 0.08, 0.125), skin), part("hair", (0.105, 0.088, 0.1), hair)]
    coat = [part("coat", (0.24, 0.27, 0.42), shirt)]
    return [*body, *head, *both[0], *both[1], *(coat if rng.random() < COATS else [])]


def limbs(posture: Posture, size: float) -> np.ndarray:
    """Place the parts of a person, T_lp (N, 17, 4, 4); `size` scales a person of 1.72 m."""
    n = len(posture.heading)
    swing = [np.sin(posture.phase), -np.sin(posture.phase)]
    lift = [np.maximum(0.0, np.cos(posture.phase)), np.maximum(0.0, -np.cos(posture.phase))]
    upright, seated = 1.0 - posture.sitting, 1.45 * posture.sitting
    thigh = [LEG_SWING * posture.vigour * upright * swing[k] + seated for k in range(2)]
    shin = [thigh[k] - KNEE_BEND * posture.vigour * upright * lift[k] - seated for k in range(2)]
    hips = np.zeros((n, 3))  # in the figure's frame: forward, left, up from the floor below it
    hips[:, 2] = np.max([THIGH * np.cos(thigh[k]) + SHIN * np.cos(shin[k]) for k in range(2)], axis=0) + FOOT
    lean = 0.06 * posture.vigour + 0.25 * np.sin(np.pi * posture.sitting)
    spine = _turn(lean)
    placed = [(hips + [0.0, 0.0, 0.03], np.tile(np.eye(3), (n, 1, 1))), (hips + spine @ [0.0, 0.0, 0.31], spine)]
    placed += [(hips + spine @ [0.02, 0.0, 0.75], spine), (hips + spine @ [-0.015, 0.0, 0.79], spine)]
    for k, side in enumerate((1.0, -1.0)):
        hip = hips + [0.0, side * HIP_WIDTH, 0.0]
        knee, ankle = hip + THIGH * _along(thigh[k]), hip + THIGH * _along(thigh[k]) + SHIN * _along(shin[k])
        toe = np.maximum(shin[k], -0.5)
        placed += [((hip + knee) / 2, _turn(-thigh[k])), ((knee + ankle) / 2, _turn(-shin[k])), (ankle + [0.06, 0.0, 0.0], _turn(-toe))]
        arm = -ARM_SWING * posture.vigour * swing[k] * (1.0 - posture.reach) + 0.55 * posture.reach + 0.5 * posture.sitting
        forearm = arm + 0.25 + 0.55 * posture.reach + 0.5 * posture.sitting
        shoulder = hips + spine @ (SHOULDER * [1.0, side, 1.0])
        elbow = shoulder + UPPER_ARM * _along(arm)
        wrist = elbow + FOREARM * _along(forearm)
        placed += [((shoulder + elbow) / 2, _turn(-arm)), ((elbow + wrist) / 2, _turn(-forearm)), (wrist, _turn(-forearm))]
    placed += [(hips + [0.0, 0.0, -0.12], _turn(0.5 * lean))]
    T_fp = np.tile(np.eye(4), (n, len(placed), 1, 1))
    for k, (centre, R) in enumerate(placed):
        T_fp[:, k, :3, 3], T_fp[:, k, :3, :3] = size * centre, R
    return standing_at(posture.xy, posture.heading)[:, None] @ T_fp


def standing_at(xy: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Return T (N, 4, 4) from frames on the floor at `xy` (N, 2), their x axes along `heading` (N,), to the level frame."""
    T = np.tile(np.eye(4), (len(heading), 1, 1))
    c, s = np.cos(heading), np.sin(heading)
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1], T[:, :2, 3] = c, -s, s, c, xy
    return T


def _along(angle: np.ndarray) -> np.ndarray:
    """Return the direction (N, 3) of a limb that hangs down, swung forward by an angle (N,)."""
    return np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=1)


def _turn(pitch: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) about the axis to the left, a positive angle bowing forward."""
    c, s, zero, one = np.cos(pitch), np.sin(pitch), np.zeros_like(pitch), np.ones_like(pitch)
    return np.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=1).reshape(-1, 3, 3)
