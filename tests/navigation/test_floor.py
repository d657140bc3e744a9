"""The floor: recovered from every attitude of the camera, told from tables and walls, and missed honestly."""

import naive
import numpy as np
import pytest
from boxroom import KINECT, READING, kinect_noise, look_along, render, round_trip

from slamcli.config.options import GroundConfig
from slamcli.geometry import se3
from slamcli.navigation import floor, floor_paper, surface_patches
from slamcli.navigation.floor import find_ground

SETTINGS = GroundConfig(stride=4)  # of images a quarter as wide as a Kinect's


def seen(T_lc, *, seed=0, clean=False):
    """Key frames of the analytic room in a world turned and moved at random; returns them and T_wl."""
    rng = np.random.default_rng(seed)
    T_wl = se3.exp(rng.normal(size=6))
    depth = [render(T) if clean else kinect_noise(render(T), rng) for T in T_lc]
    return [(z, T_wl @ T) for z, T in zip(depth, T_lc, strict=True)], T_wl


def find(frames, settings=SETTINGS, camera=KINECT, T_wc=None):
    if T_wc is None:
        T_wc = frames[0][1] if isinstance(frames, list) and frames and np.isfinite(frames[0][1]).all() else np.eye(4)
    return find_ground(frames, camera, T_wc=T_wc, settings=settings, noise=READING, rng=np.random.default_rng(0))


def error_of(found, T_wl):
    """Tilt [degrees] and height [m] of the level frame against the truth."""
    T = found.T_lw @ T_wl
    return np.degrees(np.arccos(np.clip(T[2, 2], -1.0, 1.0))), T[2, 3]


ATTITUDES = {
    "a drive around": round_trip(step=0.5, turn=0.5),
    "looking down 75 degrees": np.stack([look_along([2.5 + 0.1 * i, 3.0, 1.3], 0.3 * i, 1.3) for i in range(10)]),
    "straight down, turning": np.stack([look_along([2.5 + 0.1 * i, 3.0, 1.3], 0.3 * i, 1.55) for i in range(10)]),
    "rolled 30 degrees": np.stack([look_along([2.5 + 0.1 * i, 3.0, 1.3], 0.3 * i, 0.5, 0.5) for i in range(10)]),
    "rolled to and fro": np.stack([look_along([2.5 + 0.1 * i, 3.0, 1.3], 0.3 * i, 0.5, (-1) ** i) for i in range(10)]),
    "level, mostly walls": np.stack([look_along([4.0, 2.5, 1.2], a, 0.0) for a in np.arange(0.0, 6.0, 0.5)]),
    "over a table": np.stack([look_along([5.8 + 0.02 * i, 2.0, 1.3], a, 1.2) for i, a in enumerate(np.arange(0.0, 3.0, 0.3))]),
    "a single frame": look_along([2.5, 3.0, 0.6], 0.0, 0.3)[None],
}


@pytest.mark.parametrize("name", ATTITUDES)
def test_the_floor_is_found_whatever_the_camera_does(name):
    frames, T_wl = seen(ATTITUDES[name])
    found = find(frames)
    tilt, height = error_of(found, T_wl)
    assert found.is_found
    assert tilt < 0.3
    assert abs(height) < 0.01
    assert 0.0 < found.inlier_rms < 0.01


BLIND = {
    "camera up at the walls": [look_along([4.0, 2.5, 0.8], a, -0.5) for a in np.arange(0.0, 6.0, 0.5)],
    "camera up at one wall": [look_along([4.0 + 0.1 * i, 2.5, 0.8], 0.0, -0.5) for i in range(8)],
    "close to one wall": [look_along([7.0, 2.0 + 0.1 * i, 1.2], 0.0, 0.0) for i in range(8)],
    "up at the ceiling": [look_along([3.0, 2.5, 1.0], 0.3 * i, -1.2) for i in range(6)],
    "close to a corner": [look_along([0.8, 0.8, 1.0], 3.9, 0.25)] * 3,
}


@pytest.mark.parametrize("name", BLIND)
def test_no_floor_in_view_is_said_and_up_is_guessed(name):
    frames, T_wl = seen(BLIND[name])
    found = find(frames)
    tilt, _ = error_of(found, T_wl)
    assert not found.is_found
    assert np.isnan(found.inlier_rms)
    assert found.inlier_share == 0.0
    assert tilt < 2.0
    assert (found.T_lw @ frames[0][1])[2, 3] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.shows("ground.method")
def test_a_table_that_fills_the_view_is_the_papers_floor_but_not_ours():
    frames, T_wl = seen(ATTITUDES["over a table"])
    assert abs(error_of(find(frames), T_wl)[1]) < 0.01
    assert error_of(find(frames, GroundConfig(stride=4, method="paper")), T_wl)[1] == pytest.approx(-0.72, abs=0.02)


def test_the_papers_way_finds_a_floor_that_dominates():
    frames, T_wl = seen(ATTITUDES["looking down 75 degrees"])
    found = find(frames, GroundConfig(stride=4, method="paper"))
    tilt, height = error_of(found, T_wl)
    assert found.is_found
    assert tilt < 0.3
    assert abs(height) < 0.01


def test_the_papers_way_does_not_pass_a_wall_off_as_a_floor():
    frames, _ = seen(ATTITUDES["level, mostly walls"])
    assert not find(frames, GroundConfig(stride=4, method="paper")).is_found


def test_the_level_frame_follows_the_first_camera():
    frames, _ = seen(ATTITUDES["a drive around"])
    T_lk = find(frames).T_lw @ frames[0][1]
    np.testing.assert_allclose(T_lk[:2, 3], 0.0, atol=1e-9)
    assert T_lk[2, 3] == pytest.approx(0.6, abs=0.01)
    assert T_lk[1, 2] == pytest.approx(0.0, abs=1e-9)  # the view has no part along y
    assert T_lk[0, 2] > 0.9


@pytest.mark.parametrize("searched", [slice(0, None), slice(7, None, 3), slice(5, 6)])
def test_the_origin_is_below_the_camera_named_whichever_frames_the_floor_is_found_in(searched):
    frames, _ = seen(ATTITUDES["a drive around"])
    T_wc = frames[2][1]
    found = find(frames[searched], T_wc=T_wc)
    T_lc = found.T_lw @ T_wc
    assert found.is_found
    np.testing.assert_allclose(T_lc[[0, 1, 1], [3, 3, 2]], 0.0, atol=1e-9)  # x, y, and the view's part along y
    assert T_lc[0, 2] > 0.9


def test_the_world_frame_does_not_matter():
    frames, _ = seen(ATTITUDES["a drive around"])
    T_vw = se3.exp(np.array([3.0, -8.0, 1.0, 0.4, 2.0, -1.0]))
    moved = find([(depth, T_vw @ T_wk) for depth, T_wk in frames])
    np.testing.assert_allclose(moved.T_lw @ T_vw, find(frames).T_lw, atol=2e-3)


def test_plane_and_level_frame_say_the_same():
    frames, _ = seen(ATTITUDES["rolled 30 degrees"])
    found = find(frames)
    x_w = np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose(se3.transform(found.T_lw, x_w)[:, 2], x_w @ found.plane[:3] + found.plane[3], atol=1e-9)
    np.testing.assert_allclose(found.T_lw @ se3.inverse(found.T_lw), np.eye(4), atol=1e-9)
    assert np.linalg.det(found.T_lw[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("method", ["robust", "paper"])
@pytest.mark.parametrize("case", ["nothing", "no depth", "no pose", "one pixel"])
def test_recordings_with_nothing_to_see(method, case):
    depth = np.full((120, 160), np.nan, np.float32)
    if case == "one pixel":
        depth[60, 80] = 1.0
    T = np.full((4, 4), np.nan) if case == "no pose" else look_along([1, 1, 1], 0.0, 0.2)
    found = find([] if case == "nothing" else [(depth, T)] * 5, GroundConfig(stride=4, method=method))
    assert not found.is_found
    assert np.isfinite(found.T_lw).all()
    np.testing.assert_allclose(found.T_lw[:3, :3] @ found.T_lw[:3, :3].T, np.eye(3), atol=1e-9)


def test_every_key_frame_is_drawn_even_when_not_all_are_kept(monkeypatch):
    monkeypatch.setattr(surface_patches, "MAX_FRAMES", 4)
    frames, T_wl = seen(ATTITUDES["a drive around"][:11])
    drawn = []
    found = find(drawn.append(i) or frame for i, frame in enumerate(frames))
    assert drawn == list(range(11))
    assert error_of(found, T_wl)[0] < 0.3


def test_the_same_input_gives_the_same_floor():
    frames, _ = seen(ATTITUDES["a drive around"])
    for method in ("robust", "paper"):
        a, b = (find(frames, GroundConfig(stride=4, method=method)) for _ in range(2))
        assert a.T_lw.tobytes() == b.T_lw.tobytes()


def test_block_points_lie_on_the_surface_and_match_their_slow_twin():
    rng = np.random.default_rng(2)
    T = look_along([2.0, 2.0, 0.7], 0.4, 0.3)
    depth = kinect_noise(render(T), rng)
    for side in (4, 6):
        got = surface_patches._block_points(depth, KINECT.rays, side, 5.0, READING)
        np.testing.assert_allclose(got, naive.block_points(depth, KINECT.rays, side, 5.0), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(surface_patches._normals(got), naive.normals(got.astype(np.float64)), atol=1e-3)
    assert np.isfinite(surface_patches._normals(got)).any()
    clean = surface_patches._block_points(render(T, boxes=(), room=((0, 0, 0), (80, 80, 9))), KINECT.rays, 4, 20.0, READING)
    xyz_c = clean[20:, :, :3].reshape(-1, 3).astype(float)
    height = se3.transform(T, xyz_c[np.isfinite(xyz_c[:, 0])])[:, 2]
    assert len(height) > 300
    np.testing.assert_allclose(height, 0.0, atol=1e-4)  # inverse depth is linear on a plane: no bias


def test_image_gradient_is_the_step_from_the_upper_neighbour():
    frames, _ = seen([look_along([2.0, 2.0, 0.7], 0.4, 0.3)], clean=True)
    found, _ = surface_patches.collect(frames, KINECT, side=4, max_range=9.0, noise=READING)
    gradient = floor_paper.image_gradient(found)
    at = {tuple(cell): row for row, cell in enumerate(found.grid.tolist())}
    for row in range(0, len(found.grid), 37):
        upper = at.get((found.grid[row, 0] - 1, found.grid[row, 1]))
        expected = found.xyz[row] - found.xyz[upper] if upper is not None else np.full(3, np.nan)
        np.testing.assert_array_equal(gradient[row], expected)


def test_fit_plane_minimizes_the_sum_of_distances():
    rng = np.random.default_rng(4)
    normal = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    x = rng.uniform(-2, 2, (400, 3))
    x -= ((x @ normal) - 0.3 + rng.normal(0, 0.002, 400))[:, None] * normal
    x[:40] += 0.05 * normal  # a tenth of outliers on one side would pull a least-squares plane by 5 mm
    plane = surface_patches.fit_plane(x, np.ones(400), np.array([0.0, 0.0, 1.0, -0.3]))
    assert abs(plane[3] + 0.3) < 1e-3
    total = np.abs(x @ plane[:3] + plane[3]).sum()
    for _ in range(50):
        other = plane + rng.normal(0, 0.003, 4)
        other /= np.linalg.norm(other[:3])
        assert np.abs(x @ other[:3] + other[3]).sum() > total - 1e-3


def test_up_is_found_within_a_few_degrees_before_any_floor():
    frames, T_wl = seen(ATTITUDES["level, mostly walls"])
    up = floor.vertical(*surface_patches.collect(frames, KINECT, side=4, max_range=5.0, noise=READING))
    assert np.degrees(np.arccos(up @ T_wl[:3, 2])) < 1.0
