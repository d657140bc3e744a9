"""What a map's usefulness to a robot rests on, measured: floor seen, depth missing, walls alone in view, surfaces that lie twice in the map.

Everything is in the level frame (z up, floor at z = 0). A view is what one frame's coarse depth image shows, as oriented points.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import f8, i8

from slamcli.depth import icp_kernels
from slamcli.depth.icp import OrientedPoints
from slamcli.geometry import se3
from slamcli.jit.kernel import kernel
from slamcli.schema import Grid

MOST_VIEWS = 60  # looked at, evenly spread; every pair of them is compared
FLOOR_BAND = 0.06  # [m] a point of the floor is at most this high or low, twice the noise of its depth added
UPWARD = 0.9  # cosine: the normal of a floor point from the vertical
LEAST_FLOOR = 0.01  # share of a view's pixels that show floor, or the view has not seen it
SAMPLED = 16  # every so many points of a view are compared with other views
SAME_SURFACE = 0.9  # cosine between the normals of two points of one surface
THICKNESS, THICKNESS_SIGMAS = 0.03, 3.0  # [m] two points of one surface lie within this, so many sigma of both readings added
FARTHEST_TWIN = 0.6  # [m] from a surface to its double; what is farther apart is two things
LEAST_TWIN = 0.02  # share of a view's pixels in which another shows a surface standing in free space
FLAT = 0.04  # [m] points of a flat wall lie within this of a plane, twice the noise added
NOISE_SIGMAS = 2.0  # twice the noise
FEWEST = 10  # sampled points that a wall is judged by
SAME_WAY = 0.2  # cosine between the axes of two views that may show one surface
NEAREST = 0.1  # [m] before the other camera, from where on a point can be seen in its image
PATH_SQUARE = 0.5  # [m] about a robot's width
UPRIGHT = 0.5  # cosine of a wall's normal to the vertical at most


@dataclass(frozen=True)
class FrameSurface:
    """What one frame shows, and from where."""

    T_lc: np.ndarray  # (4, 4) camera to level frame
    surface: OrientedPoints  # its surface, in the camera's frame
    missing: float  # share of the pixels without a reading

    @property
    def xyz_l(self) -> np.ndarray:
        """Return the points (N, 3) in the level frame [m]."""
        return se3.transform(self.T_lc, self.surface.xyz.astype(np.float64))

    @property
    def normal_l(self) -> np.ndarray:
        """Return the normals (N, 3) in the level frame."""
        return self.surface.normal @ self.T_lc[:3, :3].T


@dataclass(frozen=True)
class MapEvidence:
    """The figures a verdict rests on."""

    free_area: float  # [m^2] of free cells
    path_area: float  # [m^2] of the squares of PATH_SQUARE that the camera crossed: what a robot that drove there has under it
    path_known: float  # share of the frames whose camera stands over a cell that is free or occupied
    is_floor_found: bool
    views: int  # looked at
    views_with_floor: int
    views_of_a_wall: int  # that show one flat wall and nothing else
    missing: float  # share of the depth images' pixels without a reading, median
    views_doubled: int  # in whose free space another view puts the very surface that they see behind it
    doubled_by: float  # [m] from a surface to its double, median; NaN where there is none
    camera_height: float  # [m] above the floor, median; NaN without a floor
    camera_pitch_deg: float  # [degrees] by which the camera looks down, median


def measure(grid: Grid, T_lc: np.ndarray, views: Sequence[FrameSurface], *, is_floor_found: bool, max_range: float) -> MapEvidence:
    """Measure what a map is worth to a robot.

    T_lc : (F, 4, 4) camera to level frame of every frame, NaN = lost
    views : of frames spread over the recording
    max_range : [m] to which the grid uses depth: floor farther away is not seen
    """
    T_lc = T_lc[np.isfinite(T_lc[:, 0, 0])]
    twins = [twin for twin in (twin_distance(view, views) for view in views) if np.isfinite(twin)]
    return MapEvidence(
        free_area=float((grid.state == 0).sum() * grid.resolution**2),
        path_area=len(np.unique(np.floor(T_lc[:, :2, 3] / PATH_SQUARE), axis=0)) * PATH_SQUARE**2,
        path_known=known_share(grid, T_lc[:, :3, 3]),
        is_floor_found=is_floor_found,
        views=len(views),
        views_with_floor=sum(is_floor_found and sees_floor(view, max_range=max_range) for view in views),
        views_of_a_wall=sum(is_flat_wall(view) for view in views),
        missing=float(np.median([view.missing for view in views])) if views else 1.0,
        views_doubled=len(twins),
        doubled_by=float(np.median(twins)) if twins else np.nan,
        camera_height=float(np.median(T_lc[:, 2, 3])) if is_floor_found and len(T_lc) else np.nan,
        camera_pitch_deg=float(np.degrees(np.median(np.arcsin(np.clip(-T_lc[:, 2, 2], -1, 1))))) if len(T_lc) else np.nan,
    )


def known_share(grid: Grid, xyz_l: np.ndarray) -> float:
    """Return the share of the places (N, 3) [m] that lie over a cell whose state is known."""
    if not len(xyz_l):
        return 0.0
    column, row = np.floor((xyz_l[:, :2] - grid.origin) / grid.resolution).astype(np.int64).T
    inside = (row >= 0) & (column >= 0) & (row < grid.state.shape[0]) & (column < grid.state.shape[1])
    return float((grid.state[row[inside], column[inside]] >= 0).sum() / len(xyz_l))


def sees_floor(view: FrameSurface, *, max_range: float) -> bool:
    """Tell whether a view shows enough of the floor, within `max_range` [m] of the camera, for the grid to learn from it."""
    sigma = np.sqrt(view.surface.variance)
    is_floor = (
        (np.abs(view.xyz_l[:, 2]) < FLOOR_BAND + NOISE_SIGMAS * sigma)
        & (view.normal_l[:, 2] > UPWARD)
        & (view.surface.xyz[:, 2] < max_range)
    )
    return bool(is_floor.sum() >= LEAST_FLOOR * view.surface.row.size)


def is_flat_wall(view: FrameSurface, *, least: float = 0.9) -> bool:
    """Tell whether one upright plane holds at least the share `least` of what a view shows."""
    xyz, normal = view.xyz_l[::SAMPLED], view.normal_l[::SAMPLED]
    sigma = NOISE_SIGMAS * np.sqrt(view.surface.variance[::SAMPLED])
    if len(xyz) < FEWEST:
        return False
    on_plane = np.ones(len(xyz), dtype=bool)
    for _ in range(4):
        middle, n = np.median(xyz[on_plane], axis=0), normal[on_plane].mean(axis=0)
        n /= max(np.linalg.norm(n), 1e-9)
        on_plane = np.abs((xyz - middle) @ n) < FLAT + sigma
        if on_plane.sum() < FEWEST:
            return False
    return bool(on_plane.mean() >= least and abs(n[2]) < UPRIGHT)


def twin_distance(view: FrameSurface, others: Sequence[FrameSurface]) -> float:
    """Return how far in front of a surface some other view puts that same surface [m]; NaN where all agree with what the view sees.

    A view looks through the space between the camera and the surface it sees: where another view has a surface of the same direction
    there, most of what both show, one of the two lies in the wrong place.
    """
    found = np.nan
    for other in others:
        agree, in_front = compare(other, view)
        if len(in_front) * SAMPLED >= LEAST_TWIN * view.surface.row.size and len(in_front) > agree:
            found = np.nanmax([found, np.median(in_front)])
    return float(found)


def compare(source: FrameSurface, target: FrameSurface) -> tuple[int, np.ndarray]:
    """Look at a view's points from another one; returns how many lie on the surface seen there, and how far in front the others are [m].

    Counted are points of a surface of the same direction, at most FARTHEST_TWIN in front of that seen.
    """
    nothing = 0, np.zeros(0)
    if source.T_lc[:3, 2] @ target.T_lc[:3, 2] < SAME_WAY or not len(source.surface) or not len(target.surface):  # they look apart
        return nothing
    T_ts = se3.inverse(target.T_lc) @ source.T_lc
    fitted = np.zeros(2, dtype=np.int64)
    in_front = np.empty(len(source.surface) // SAMPLED + 1)
    _compare(np.ascontiguousarray(T_ts), source.surface.points, target.surface.points, target.surface.view, in_front, fitted)
    return int(fitted[0]), in_front[: fitted[1]]


@kernel
def _compare(
    T_ts: f8[:, ::1],
    seen: icp_kernels.Points,
    met_by: icp_kernels.Points,
    view: icp_kernels.PointImage,
    in_front: f8[::1],
    fitted: i8[::1],
) -> None:
    """Count in fitted[0] the sampled points that lie on the surface they meet; list how far the others are in front, fitted[1] of them."""
    xyz, normal, variance = seen
    met_xyz, met_normal, met_variance = met_by
    row_at, pinhole = view
    height, width = row_at.shape
    for k in range(0, len(xyz), SAMPLED):
        p, n = xyz[k], normal[k]
        z = T_ts[2, 0] * p[0] + T_ts[2, 1] * p[1] + T_ts[2, 2] * p[2] + T_ts[2, 3]
        if not z > NEAREST:
            continue
        x = T_ts[0, 0] * p[0] + T_ts[0, 1] * p[1] + T_ts[0, 2] * p[2] + T_ts[0, 3]
        y = T_ts[1, 0] * p[0] + T_ts[1, 1] * p[1] + T_ts[1, 2] * p[2] + T_ts[1, 3]
        column, line = np.rint(x / z * pinhole[0] + pinhole[2]), np.rint(y / z * pinhole[1] + pinhole[3])
        if not (0 <= line < height and 0 <= column < width):
            continue
        met = row_at[int(line), int(column)]
        if met < 0:
            continue
        q, m = met_xyz[met], met_normal[met]
        cosine = 0.0
        for i in range(3):
            cosine += (T_ts[i, 0] * n[0] + T_ts[i, 1] * n[1] + T_ts[i, 2] * n[2]) * m[i]
        distance = (x - q[0]) * m[0] + (y - q[1]) * m[1] + (z - q[2]) * m[2]
        limit = THICKNESS + THICKNESS_SIGMAS * (np.sqrt(variance[k]) + np.sqrt(met_variance[met]))
        if cosine > SAME_SURFACE and abs(distance) < limit:
            fitted[0] += 1
        elif cosine > SAME_SURFACE and limit <= distance < FARTHEST_TWIN:
            in_front[fitted[1]] = distance
            fitted[1] += 1
