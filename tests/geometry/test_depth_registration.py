"""Depth brought to the colour camera: against a slow twin, on planes that are known, at edges, and in other sizes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from slamcli.geometry.camera import EQUIDISTANT, Camera
from slamcli.geometry.depth_registration import OVERLAP, REACH, SURFACE, Registration, resized

COLOUR = Camera(160, 120, 131.0, 132.0, 80.0, 61.0)
DEPTH = Camera(160, 120, 146.0, 145.0, 79.0, 60.0)
LENSES = {
    "pinhole": {},
    "polynomial": {"k1": 0.1, "k2": -0.2, "p1": 0.002, "p2": -0.001},
    "rational": {"k1": 0.58, "k2": -2.49, "k3": 1.36, "k4": 0.46, "k5": -2.33, "k6": 1.3},
    "equidistant": {"k1": 0.02, "k2": -0.01, "k3": 0.003, "lens": EQUIDISTANT},
}


def pose(turn: tuple[float, float, float], offset: tuple[float, float, float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array(turn, dtype=float))[0], offset
    return T


T_CD = pose((0.004, -0.006, 0.008), (0.025, 0.002, -0.003))


def rise(line: np.ndarray, at: int) -> float:
    """By how much a line of readings grows a step, at one of them; 0 where it is not straight."""
    if not REACH <= at < len(line) - REACH:
        return 0.0
    before, here, after = line[[at - REACH, at, at + REACH]].astype(float)
    is_straight = abs(before + after - 2 * here) <= SURFACE * here and abs(after - before) <= 2 * REACH * SURFACE * here
    return (after - before) / (2 * REACH) if is_straight else 0.0


def naively(depth: np.ndarray, given: Registration) -> np.ndarray:
    """Every reading laid on the pixels of its footprint, one after another."""
    to, of = given.colour_camera, given.depth_camera
    out, away = (np.full((to.height, to.width), np.inf) for _ in range(2))
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            d = float(depth[row, column])
            if not d > 0:
                continue
            ray = of.normalize(np.array([[column, row]], dtype=float))[0]
            x = given.T_cd[:3, :3] @ (d * np.array([*ray, 1.0])) + given.T_cd[:3, 3]
            u, v = to.distort(to.project(x))
            if x[2] <= 0 or not (-0.5 < u < to.width - 0.5 and -0.5 < v < to.height - 0.5):
                continue
            steps = np.linalg.inv(np.diag([to.fx, to.fy]) @ given.T_cd[:2, :2] @ np.diag([1 / of.fx, 1 / of.fy])) * (x[2] / d) ** 2
            slope_u, slope_v = np.array([rise(depth[row], column), rise(depth[:, column], row)]) @ steps
            half_u, half_v = 0.5 * OVERLAP * d / x[2] * np.array([to.fx / of.fx, to.fy / of.fy])
            for j in range(max(int(np.ceil(v - half_v)), 0), min(int(np.floor(v + half_v)), to.height - 1) + 1):
                for i in range(max(int(np.ceil(u - half_u)), 0), min(int(np.floor(u + half_u)), to.width - 1) + 1):
                    z = x[2] + slope_u * (i - u) + slope_v * (j - v)
                    is_before, is_behind = x[2] * (1 + SURFACE) < out[j, i], x[2] * (1 - SURFACE) > out[j, i]
                    if is_before or (not is_behind and np.hypot(i - u, j - v) < away[j, i]):
                        out[j, i], away[j, i] = z, np.hypot(i - u, j - v)
    return np.where(np.isfinite(out), out, np.nan)


@pytest.mark.parametrize("is_smooth", [True, False])
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_kernel_equals_its_slow_twin(lens: dict, is_smooth: bool) -> None:
    rng = np.random.default_rng(1)
    small = replace(DEPTH, width=60, height=45, fx=55.0, fy=54.0, cx=29.0, cy=22.0)
    depth = np.geomspace(0.08, 4.0, 2700).astype(np.float32)[rng.permutation(2700)].reshape(45, 60)  # so near that paths do not hold, too
    if is_smooth:
        depth = np.fromfunction(lambda i, j: 1.0 + 0.01 * i + 0.005 * j + 0.3 * (j > 40), (45, 60)).astype(np.float32)
    depth[rng.uniform(size=depth.shape) < 0.2] = np.nan
    given = Registration(small, replace(COLOUR, **lens), T_CD)
    expected, found = naively(depth, given), given.apply(depth)
    differs = ~np.isclose(found, expected, rtol=1e-5, equal_nan=True)
    assert differs.mean() < 2e-3  # rays are kept as float32: footprints that end on a pixel may go either way


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
@pytest.mark.parametrize("focal", [94.0, 146.0])
def test_a_plane_is_seen_where_it_is(lens: dict, focal: float) -> None:
    """The plane n x = c in the colour camera's axes: both cameras' depths are known in closed form."""
    normal, c = np.array([0.2, -0.1, 1.0]), 1.5
    depth_camera, colour_camera = replace(DEPTH, fx=focal, fy=focal), replace(COLOUR, **lens)
    ray = np.concatenate([depth_camera.rays.astype(float), np.ones((120, 160, 1))], axis=2) @ T_CD[:3, :3].T
    depth = ((c - normal @ T_CD[:3, 3]) / (ray @ normal)).astype(np.float32)
    found = Registration(depth_camera, colour_camera, T_CD).apply(depth)
    true = c / (np.concatenate([colour_camera.rays.astype(float), np.ones((120, 160, 1))], axis=2) @ normal)
    inside = np.s_[14:-14, 18:-18]  # beside the rim, which the other camera does not see
    assert np.isfinite(found[inside]).all()
    step = np.abs(np.gradient(true)[0]).max() + np.abs(np.gradient(true)[1]).max()
    error = np.abs(found - true)[inside]
    assert np.mean(error) < 0.03 * step  # the reading beside a pixel alone would be a quarter of a step off
    assert np.max(error) < 0.3 * step  # at a lens' rim its magnification is another than in the middle


@pytest.mark.parametrize("roll", [-np.pi / 2, 0.6, np.pi])
def test_a_plane_is_seen_where_it_is_by_a_depth_camera_that_is_mounted_askew(roll: float) -> None:
    normal, c = np.array([0.3, -0.2, 1.0]), 1.5
    T_cd = pose((0.0, 0.0, roll), (0.01, 0.02, 0.0))
    ray = np.concatenate([DEPTH.rays.astype(float), np.ones((120, 160, 1))], axis=2) @ T_cd[:3, :3].T
    depth = ((c - normal @ T_cd[:3, 3]) / (ray @ normal)).astype(np.float32)
    found = Registration(DEPTH, COLOUR, T_cd).apply(depth)
    true = c / (np.concatenate([COLOUR.rays.astype(float), np.ones((120, 160, 1))], axis=2) @ normal)
    middle = np.s_[40:80, 60:100]
    is_seen = np.isfinite(found[middle])
    assert is_seen.mean() > 0.8  # footprints are upright: pixels between readings that lie askew stay open
    np.testing.assert_allclose(found[middle][is_seen], true[middle][is_seen], atol=2e-4)


def test_the_nearer_surface_wins_and_hides_what_is_behind() -> None:
    depth = np.full((120, 160), 3.0, np.float32)
    depth[40:80, 60:100] = 1.0
    T_cd = pose((0, 0, 0), (0.1, 0, 0))
    found = Registration(DEPTH, replace(DEPTH), T_cd).apply(depth)
    shift = 0.1 * DEPTH.fx  # px at 1 m; a third of that at 3 m
    middle = found[60]
    near = np.flatnonzero(middle < 2.0)
    assert near[0] == pytest.approx(60 + shift, abs=1.1) and near[-1] == pytest.approx(99 + shift, abs=1.1)
    hole = np.flatnonzero(np.isnan(middle[20:]))  # beside the near surface: seen by neither
    assert len(hole) == pytest.approx(shift * 2 / 3, abs=2.1)
    assert set(np.round(np.unique(middle[np.isfinite(middle)]), 4)) == {1.0, 3.0}


def test_nothing_comes_of_nothing() -> None:
    given = Registration(DEPTH, COLOUR, T_CD)
    assert np.isnan(given.apply(np.full((120, 160), np.nan, np.float32))).all()
    behind = Registration(DEPTH, COLOUR, pose((0, 0, 0), (0, 0, -5.0)))
    assert np.isnan(behind.apply(np.ones((120, 160), np.float32))).all()
    assert np.isnan(given.apply(np.full((120, 160), np.inf, np.float32))).all()


def test_equal_cameras_change_nothing() -> None:
    rng = np.random.default_rng(2)
    depth = cv2.GaussianBlur(rng.uniform(1, 3, (120, 160)).astype(np.float32), (0, 0), 8.0)
    found = Registration(COLOUR, COLOUR, np.eye(4)).apply(depth)
    np.testing.assert_allclose(found, depth, rtol=1e-6)


@pytest.mark.parametrize("size", [(256, 192), (640, 480), (50, 40), (160, 120)])
def test_resizing_keeps_a_slanted_plane(size: tuple[int, int]) -> None:
    def plane(width: int, height: int) -> np.ndarray:
        x, y = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
        return (2.0 + 0.4 * x[None] + 0.2 * y[:, None]).astype(np.float32)

    found = resized(plane(160, 120), *size)
    inside = np.s_[size[1] // 60 + 1 : -size[1] // 60 - 1, size[0] // 60 + 1 : -size[0] // 60 - 1]
    assert found.shape == size[::-1] and found.dtype == np.float32
    np.testing.assert_allclose(found[inside], plane(*size)[inside], atol=2e-3)


def test_resizing_invents_no_depth_at_a_jump_and_spreads_no_hole() -> None:
    depth = np.full((12, 16), 1.0, np.float32)
    depth[:, 8:] = 2.0
    depth[5, 3] = np.nan
    found = resized(depth, 64, 48)
    assert set(np.unique(found[np.isfinite(found)])) == {1.0, 2.0}
    assert np.isnan(found).sum() == 16  # the pixel itself, four times as large each way


@pytest.mark.parametrize("turn", [np.radians(70.0), np.pi / 2])
def test_cameras_that_hardly_face_the_same_way_get_readings_as_they_are(turn: float) -> None:
    """No slope is followed there: it would be of another direction, or without bound."""
    wide = replace(DEPTH, fx=45.0, fy=45.0)
    given = Registration(wide, replace(COLOUR, fx=45.0, fy=45.0), pose((0.0, turn, 0.0), (0.0, 0.0, 0.0)))
    depth = np.fromfunction(lambda i, j: 2.0 + 0.01 * j + 0.005 * i, (120, 160)).astype(np.float32)
    ray = np.concatenate([wide.rays.astype(float), np.ones((120, 160, 1))], axis=2) @ given.T_cd[:3, :3].T
    found = given.apply(depth)
    found = found[np.isfinite(found)]
    assert len(found) > 500
    apart = np.abs(np.sort((depth * ray[..., 2]).ravel())[:, None] - found[::7]).min(axis=0)
    assert apart.max() < 1e-5
