"""The floor: from the key frames' depth to the level frame `l` (z up, floor at z = 0).

The floor is the lowest well-supported horizontal plane, not the largest one: a camera over a desk sees mostly desk. What is
horizontal is agreed on by all key frames together: a direction along which many surfaces face, at right angles to which many others
do, and that suits a camera held roughly upright.
"""

from collections.abc import Iterable

import numpy as np

from slamcli.config.options import GroundConfig
from slamcli.geometry import elementary
from slamcli.geometry.algebra import eigh, product
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_noise import DepthNoise
from slamcli.navigation.floor_paper import paper_plane
from slamcli.navigation.surface_patches import Patches, Support, collect, fit_plane
from slamcli.schema import Ground

UPRIGHT_ROLL = 0.35  # sine of the roll at which a direction's claim to be up has fallen to exp(-1/2)
UPRIGHT_MIN = 0.1  # least mean cosine between up and the images' up: the camera looks at most some 84 degrees down
TURNING = 0.03  # second moment of the images' rows across their main direction: some 10 degrees to either side
PARALLEL = 0.985  # cosine: within 10 degrees of a direction
ORTHOGONAL = 0.17  # cosine: within 10 degrees of a right angle
MAX_NORMALS = 20000  # used for the vertical: more cost time and change nothing
LEVEL_BIN = 0.02  # [m] height histogram
BELOW = 0.1  # [m] what lies deeper than this below a plane says that the room goes on there
INLIER_SIGMAS, BELOW_SIGMAS = 2.0, 3.0  # of a patch, by which an inlier may be off, and a patch must be to lie below
NO_HEADING = 0.2  # sine: a camera that looks nearer to the vertical has its images' up for a heading
NO_DIRECTION = 1e-3  # length of a mean of unit vectors that cancel out
DRAWN_CLOSER = (0.94, 0.97, PARALLEL, PARALLEL)  # cosines, round by round, of the normals that a direction is the mean of
PEAK_HALF_WIDTH = 0.12  # [m] first guess of a plane's inliers; takes up 2 degrees of tilt over some 3 m


def find_ground(
    frames: Iterable[tuple[np.ndarray, np.ndarray]],
    camera: Camera,
    *,
    T_wc: np.ndarray,
    settings: GroundConfig,
    noise: DepthNoise,
    rng: np.random.Generator,
) -> Ground:
    """Find the floor and the frame in which it is level.

    frames : (depth (H, W) float32 [m], NaN = none; T_wk (4, 4) camera to world) per key frame, any choice of them
    noise : of a single depth reading
    T_wc : (4, 4) camera to world, of the camera below which the level frame has its origin and whose heading is the x axis
    Returns Ground; `is_found` is False where no floor is in view, and `T_lw` then only turns the world so that z is up at best guess,
    with that camera at z = 0.
    """
    patches, T_wk = collect(frames, camera, side=settings.stride, max_range=settings.max_range, noise=noise)
    if len(T_wk) == 0:
        return _not_found(T_wc, up=-T_wc[:3, 1])
    up = vertical(patches, T_wk)
    if settings.method == "paper":
        support = paper_plane(patches, up, settings=settings, rng=rng)
    else:
        support = lowest_plane(patches, up, settings=settings)
    if support is None:
        return _not_found(T_wc, up)
    above = float(np.median(product(T_wk[:, :3, 3], support.plane[:3]) + support.plane[3]))
    plane = support.plane if above >= 0.0 else -support.plane  # the camera is above the floor
    if abs(above) < settings.min_height or product(plane[:3], up) < settings.min_cosine:  # a table at eye level, a wall
        return _not_found(T_wc, up)
    distance = product(patches.xyz[support.inliers], plane[:3]) + plane[3]
    return Ground(
        T_lw=level_frame(plane, T_wc),
        plane=plane,
        inlier_rms=np.array(np.sqrt(np.mean(distance**2))),
        inlier_share=np.array(len(support.inliers) / support.n_candidates),
        is_found=np.array(True),
    )


def vertical(patches: Patches, T_wk: np.ndarray) -> np.ndarray:
    """Find the direction up (3,) in the world, by the agreement of all surfaces and the cameras' attitude."""
    right, image_up = T_wk[:, :3, 0], -T_wk[:, :3, 1]
    rows = np.flatnonzero(np.isfinite(patches.normal[:, 0]))
    normal = patches.normal[rows[:: max(1, len(rows) // MAX_NORMALS)]]
    best, best_score = _unit(image_up.mean(axis=0), image_up[0]), 0.0
    frequent = _frequent_directions(normal)
    # Where no horizontal surface is in view, up is at right angles to two walls, or to one wall and the images' rows.
    upright = [np.cross(a, b) for i, a in enumerate(frequent[:4]) for b in frequent[:i]]
    upright += [np.cross(a, right.mean(axis=0)) for a in frequent[:4]]
    for direction in (*frequent, *(_unit(d, best) for d in upright), best):
        direction = direction * _sign(direction, T_wk)
        cosine = np.abs(product(normal, direction))
        claim = np.mean(cosine > PARALLEL) + 0.5 * np.mean(cosine < ORTHOGONAL) if len(normal) else 1.0
        score = claim * elementary.exp(-0.5 * (product(right, direction) / UPRIGHT_ROLL) ** 2).mean()
        if score > best_score and _suits_camera(direction, T_wk):
            best, best_score = direction, score
    return best


def _sign(direction: np.ndarray, T_wk: np.ndarray) -> float:
    """Return the sign that makes a vertical direction point up: as the images do or, where these lie flat, against the view."""
    lean = float(product(-T_wk[:, :3, 1], direction).mean())
    if abs(lean) < UPRIGHT_MIN:
        lean = float(product(-T_wk[:, :3, 2], direction).mean())
    return 1.0 if lean >= 0.0 else -1.0


def _suits_camera(up: np.ndarray, T_wk: np.ndarray) -> bool:
    """Say whether a camera is held so: upright, or looking straight down while it turns.

    A wall before an upright camera is told from a floor below one that looks down by the latter's turning about the view.
    """
    if product(-T_wk[:, :3, 1], up).mean() >= UPRIGHT_MIN:
        return True
    right = T_wk[:, :3, 0]
    turns = eigh(product(right.T, right) / len(right))[0][1]
    return bool(turns > TURNING and product(-T_wk[:, :3, 2], up).mean() > PARALLEL)


def _unit(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector, axis=-1)
    return vector / length if length > NO_DIRECTION else otherwise


def _frequent_directions(normal: np.ndarray, *, count: int = 24) -> list[np.ndarray]:
    """Return the directions (3,) most normals share, refined to the mean of those near each; opposite normals count as one."""
    bins = (np.round(normal * 6.0).astype(np.int64) * [169, 13, 1]).sum(
        axis=-1
    )  # -6..6 per axis; the opposite normal's number is the negative
    counts = np.bincount(np.abs(bins))
    directions = []
    for number in np.argsort(-counts, kind="stable")[:count]:
        members = np.abs(bins) == number
        if not members.any():
            break
        direction = (normal[members] * np.where(bins[members] < 0, -1.0, 1.0)[:, None]).sum(axis=0)
        for least in DRAWN_CLOSER:
            cosine = product(normal, direction / np.linalg.norm(direction, axis=-1))
            near = np.abs(cosine) > least
            direction = (normal[near] * np.sign(cosine[near])[:, None]).sum(axis=0)
            if not direction.any():
                break
        else:
            directions.append(direction / np.linalg.norm(direction, axis=-1))
    return directions


def lowest_plane(patches: Patches, up: np.ndarray, *, settings: GroundConfig) -> Support | None:
    """Find the lowest horizontal plane that enough patches support and that has no surface below it; None where there is none."""
    rows = np.flatnonzero(product(patches.normal, up) > settings.min_cosine)
    least = max(settings.min_patches, settings.min_share * len(rows))
    if len(rows) < least:
        return None
    for level in _levels(product(patches.xyz[rows], up), least):
        support = _refined(patches, rows, np.append(up, -level), least, settings)
        if support and product(support.plane[:3], up) > settings.min_cosine and _nothing_below(patches, support, settings):
            return support
    return None


def _refined(patches: Patches, rows: np.ndarray, plane: np.ndarray, least: float, settings: GroundConfig) -> Support | None:
    """Fit a plane to the patches near it, [L] (18), drawing them closer from round to round; None when too few are left."""
    inliers = rows
    for half_width in (PEAK_HALF_WIDTH, 0.5 * PEAK_HALF_WIDTH, settings.distance, settings.distance):
        residual = product(patches.xyz[rows], plane[:3]) + plane[3]
        inliers = rows[np.abs(residual) < half_width + INLIER_SIGMAS * patches.sigma[rows]]
        if len(inliers) < least:
            return None
        plane = fit_plane(patches.xyz[inliers], 1.0 / patches.sigma[inliers], plane)
    return Support(plane, inliers, len(rows))


def _levels(height: np.ndarray, least: float) -> np.ndarray:
    """Return the heights, lowest first, at which upward-facing patches gather."""
    low = height.min()
    count = np.bincount(((height - low) / LEVEL_BIN).astype(np.int64))
    window = int(PEAK_HALF_WIDTH / LEVEL_BIN)
    near = np.convolve(count, np.ones(2 * window + 1), mode="same")[: len(count)]
    padded = np.pad(count, window)
    is_peak = (near >= least) & (count >= np.lib.stride_tricks.sliding_window_view(padded, 2 * window + 1).max(axis=1))
    return low + (np.flatnonzero(is_peak) + 0.5) * LEVEL_BIN


def _nothing_below(patches: Patches, support: Support, settings: GroundConfig) -> bool:
    """Say whether hardly anything lies below a plane: under a table top the room goes on."""
    height = product(patches.xyz, support.plane[:3]) + support.plane[3]
    below = np.count_nonzero(height < -BELOW - BELOW_SIGMAS * patches.sigma)
    return bool(below <= settings.max_below * len(support.inliers))


def level_frame(plane: np.ndarray, T_wc: np.ndarray) -> np.ndarray:
    """Return T_lw (4, 4): z along the plane's normal, z = 0 on it, origin below the camera T_wc, x along that camera's heading."""
    up = plane[:3]
    heading = T_wc[:3, 2] - product(T_wc[:3, 2], up) * up
    if np.linalg.norm(heading, axis=-1) < NO_HEADING:  # looking straight down: the image's up is ahead
        heading = -T_wc[:3, 1] + product(T_wc[:3, 1], up) * up
    x = heading / np.linalg.norm(heading, axis=-1)
    T_lw = np.eye(4)
    T_lw[:3, :3] = np.stack([x, np.cross(up, x), up])
    foot = T_wc[:3, 3] - (product(T_wc[:3, 3], up) + plane[3]) * up
    T_lw[:3, 3] = product(-T_lw[:3, :3], foot)
    return T_lw


def _not_found(T_wc: np.ndarray, up: np.ndarray) -> Ground:
    plane = np.append(up, product(-up, T_wc[:3, 3]))
    return Ground(
        T_lw=level_frame(plane, T_wc),
        plane=plane,
        inlier_rms=np.array(np.nan),
        inlier_share=np.array(0.0),
        is_found=np.array(False),
    )
