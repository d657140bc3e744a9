"""The floor as [L] section 2 finds it: frequent gradients of the ground key frames, then RANSAC over three key frames.

The text leaves the choice of ground key frames to the reader; here they are the key frames in which most of what is seen faces up. Kept
beside the sturdier way of `ground` for comparison: it takes the plane that dominates the middle of these images for the floor, and so a
desk, or a wall, whose gradients are all equal while those of a floor grow with distance.
"""

import numpy as np

from slamcli.config.options import GroundConfig
from slamcli.geometry.algebra import product
from slamcli.navigation.surface_patches import Patches, Support, fit_plane

CLASSES = 3  # most frequent gradients kept
GROUND_SHARE = 0.3  # of the key frames, those with the most ground are the ground key frames
FACES_UP = 0.9  # cosine
ON_A_LINE = 1e-6  # [m^2] twice the area of the triangle of three points that fix no plane


def paper_plane(patches: Patches, up: np.ndarray, *, settings: GroundConfig, rng: np.random.Generator) -> Support | None:
    """Find the floor's plane by [L] 2.1 to 2.3; None where fewer than three key frames show ground.

    up : (3,) direction up in the world, to choose the ground key frames by
    """
    rows = ground_points(patches, up, settings=settings)
    frames = np.unique(patches.frame[rows])
    if len(frames) < 3:
        return None
    first, last = np.searchsorted(patches.frame[rows], frames, "left"), np.searchsorted(patches.frame[rows], frames, "right")
    xyz = patches.xyz[rows]
    best, best_count = None, 0
    for _ in range(settings.rounds):
        chosen = rng.choice(len(frames), 3, replace=False)
        # The text can be read as three points of each of the three key frames; one of each is what a plane needs.
        plane = _plane_through(xyz[rng.integers(first[chosen], last[chosen])])
        if plane is None:
            continue
        count = int(np.count_nonzero(np.abs(product(xyz, plane[:3]) + plane[3]) < settings.distance))
        if count > best_count:
            best, best_count = plane, count
    if best is None or best_count < 3:
        return None
    inliers = rows[np.abs(product(xyz, best[:3]) + best[3]) < settings.distance]
    return Support(fit_plane(patches.xyz[inliers], np.ones(len(inliers)), best), inliers, len(rows))


def ground_points(patches: Patches, up: np.ndarray, *, settings: GroundConfig) -> np.ndarray:
    """Return the rows of the points with the three most frequent gradients in the middle of the ground key frames, [L] 2.1."""
    gradient = image_gradient(patches)
    extent = np.array(patches.shape)
    offset = np.abs(patches.grid - (extent - 1) / 2.0)
    is_middle = (offset <= 0.5 * settings.middle * extent).all(axis=1) & np.isfinite(gradient[:, 0])
    kept = [_frequent(gradient, np.flatnonzero(is_middle & (patches.frame == k)), settings) for k in ground_frames(patches, up)]
    return np.sort(np.concatenate(kept)) if kept else np.zeros(0, dtype=np.int64)


def ground_frames(patches: Patches, up: np.ndarray) -> np.ndarray:
    """Return the key frames with the most patches that face up, at least three."""
    count = np.bincount(patches.frame[product(patches.normal, up) > FACES_UP], minlength=int(patches.frame.max(initial=-1)) + 1)
    return np.sort(np.argsort(-count, kind="stable")[: max(3, int(np.ceil(GROUND_SHARE * len(count))))])


def _frequent(gradient: np.ndarray, rows: np.ndarray, settings: GroundConfig) -> np.ndarray:
    """Keep the rows with the most frequent gradients."""
    bins = np.floor(gradient[rows] / settings.gradient_bin).astype(np.int64)
    _, of_row, counts = np.unique(bins, axis=0, return_inverse=True, return_counts=True)
    return rows[np.isin(of_row.ravel(), np.argsort(-counts, kind="stable")[:CLASSES])]


def image_gradient(patches: Patches) -> np.ndarray:
    """Return G (N, 3) [m], the step from the upper neighbour's point to each point, [L] (16); NaN where there is no upper neighbour."""
    rows, columns = patches.shape
    at = np.full((int(patches.frame.max(initial=-1)) + 1, rows, columns), -1, dtype=np.int64)
    at[patches.frame, patches.grid[:, 0], patches.grid[:, 1]] = np.arange(len(patches.xyz))
    upper = np.where(patches.grid[:, 0] > 0, at[patches.frame, patches.grid[:, 0] - 1, patches.grid[:, 1]], -1)
    return np.where(upper[:, None] >= 0, patches.xyz - patches.xyz[upper], np.nan)


def _plane_through(xyz: np.ndarray) -> np.ndarray | None:
    """Return the plane (4,) through three points (3, 3), None where they lie on a line."""
    normal = np.cross(xyz[1] - xyz[0], xyz[2] - xyz[0])
    length = np.linalg.norm(normal, axis=-1)
    if length < ON_A_LINE:
        return None
    normal = normal / length
    return np.append(normal, product(-normal, xyz[0]))
