import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slamcli.config.options import DensifyConfig, SensorConfig
from slamcli.dense import outlier_removal
from slamcli.dense.voxel_cloud import VoxelCloud
from slamcli.depth import oriented_points
from slamcli.depth.oriented_points import Surface
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera

CAMERA = Camera(160, 120, 130.0, 131.0, 79.2, 60.3)
LENS = Camera(160, 120, 130.0, 131.0, 79.2, 60.3, 0.26, -0.95, -0.005, 0.003, 1.16)


def plane_depth(camera: Camera, normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth image of the plane normal . x = -distance, the normal towards the camera."""
    rays = np.concatenate([camera.rays, np.ones((*camera.rays.shape[:2], 1))], axis=-1)
    depth = -distance / (rays @ normal)
    return np.where(depth > 0, depth, np.nan).astype(np.float32)


def noisy(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return (depth + rng.normal(size=depth.shape) * (0.0012 + 0.0019 * (depth - 0.4) ** 2)).astype(np.float32)


def see(depth: np.ndarray, camera: Camera = CAMERA, *, stride: int = 1, spacing: float = 0.0, depth_max: float = 6.0, **more) -> Surface:
    sensor = SensorConfig(depth_max=depth_max)
    return oriented_points.surface(depth, camera, settings=DensifyConfig(**more), sensor=sensor, stride=stride, spacing=spacing)


def unit(*vector: float) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


@pytest.mark.parametrize(("camera", "tolerance"), [(CAMERA, 2e-4), (LENS, 1.5e-3)])  # a window of this lens is not quite flat
@pytest.mark.parametrize("normal", [unit(0, 0, -1), unit(0.6, 0.2, -1), unit(-0.3, -1.0, -0.7)])
def test_on_an_exact_plane_points_and_normals_are_exact(camera: Camera, tolerance: float, normal: np.ndarray) -> None:
    depth = plane_depth(camera, normal, 1.4)
    seen = see(depth, camera)
    assert len(seen.pixel) > 0.5 * np.isfinite(depth[depth < 6]).sum()
    np.testing.assert_allclose(seen.xyz_c @ normal, -1.4, atol=tolerance)
    assert (seen.normal_c @ normal).min() > np.cos(np.radians(1.5))
    np.testing.assert_allclose(np.linalg.norm(seen.normal_c, axis=1), 1.0, atol=1e-5)


def test_smoothing_takes_most_of_the_noise_off_a_plane_however_slanted() -> None:
    rng = np.random.default_rng(0)
    for normal in (unit(0, 0, -1), unit(0.8, 0.5, -1)):
        depth = plane_depth(CAMERA, normal, 2.0)
        depth[~((depth > 1.5) & (depth < 4.0))] = np.nan
        seen = see(noisy(depth, rng))
        error = seen.xyz_c[:, 2] - depth.reshape(-1)[seen.pixel]
        raw = 0.0012 + 0.0019 * (seen.xyz_c[:, 2] - 0.4) ** 2
        assert 0.05 < np.sqrt(np.mean((error / raw) ** 2)) < 0.4
        assert abs(np.mean(error / raw)) < 0.05
        assert np.median(seen.normal_c @ normal) > np.cos(np.radians(8))
        predicted = np.sqrt(np.mean(error**2 * seen.weight))
        assert 0.5 < predicted < 2.0


def test_points_that_hang_in_the_air_at_a_depth_jump_are_dropped() -> None:
    depth = np.full((120, 160), 3.0, dtype=np.float32)
    depth[:, :80] = 1.0
    depth[:, 79:81] = [1.6, 2.3]
    seen = see(depth)
    z, column = seen.xyz_c[:, 2], seen.pixel % 160
    assert np.minimum(abs(z - 1.0), abs(z - 3.0)).max() < 0.01
    assert not np.isin(column, [78, 79, 80, 81]).any()
    assert np.isin([70, 90], column).all()


def test_readings_out_of_range_missing_or_alone_are_dropped() -> None:
    depth = np.full((120, 160), np.nan, dtype=np.float32)
    assert len(see(depth).pixel) == 0
    depth[60, 80] = 2.0
    assert len(see(depth).pixel) == 0
    assert len(see(np.full((120, 160), 7.0, np.float32)).pixel) == 0
    assert len(see(np.full((120, 160), 0.2, np.float32)).pixel) == 0
    assert len(see(np.zeros((120, 160), np.float32)).pixel) == 0
    assert len(see(np.full((120, 160), np.inf, np.float32)).pixel) == 0


def test_grazing_surfaces_are_dropped() -> None:
    steep = plane_depth(CAMERA, unit(0, -1, 0), 0.3)  # a floor 0.3 m below the camera
    seen = see(steep, max_angle_deg=75.0)
    cosine = -(seen.normal_c * seen.xyz_c).sum(axis=1) / np.linalg.norm(seen.xyz_c, axis=1)
    assert len(seen.pixel) > 100
    assert cosine.min() >= np.cos(np.radians(75.1))
    assert len(see(steep, max_angle_deg=87.0).pixel) > len(seen.pixel)


def test_near_surfaces_are_thinned_to_the_spacing() -> None:
    near, far = np.full((120, 160), 0.5, np.float32), np.full((120, 160), 4.0, np.float32)
    assert len(see(near, spacing=0.02).pixel) == pytest.approx(len(see(near).pixel) / 16, rel=0.1)
    assert len(see(far, spacing=0.02).pixel) == len(see(far).pixel)
    gap = np.diff(np.unique(see(near, spacing=0.02).xyz_c[:, 0])).max()
    assert gap <= 0.02 + 1e-6


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 0.05, 0.3]))
def test_a_voxel_holds_the_weighted_means_of_its_points(seed: int, side: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 300))
    xyz = rng.uniform(-1, 1, (n, 3)).astype(np.float32)
    weight = rng.uniform(0.1, 10.0, n).astype(np.float32)
    rgb = rng.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    pixel = rng.integers(0, 1200, n).astype(np.int32)
    normal = rng.normal(size=(n, 3)).astype(np.float32)
    T_wc = se3.exp(rng.normal(size=6))
    model = VoxelCloud(side)
    half = n // 2
    for rows in (slice(None, half), slice(half, None)):
        model.add(Surface(pixel[rows], xyz[rows], normal[rows], weight[rows]), rgb, T_wc)
    cloud = model.cloud()
    x_w = se3.transform(T_wc, xyz.astype(np.float64))
    expected = naive.voxel_means(np.hstack([x_w, rgb.reshape(-1, 3)[pixel], normal @ T_wc[:3, :3].T]), weight, side)
    assert len(cloud) == len(expected)
    found = {tuple(int(c) for c in np.floor(p / side)): i for i, p in enumerate(cloud.xyz.astype(np.float64))}
    for cell, mean in expected.items():
        i = found.get(cell)
        if i is None:  # a mean on the voxel's face, rounded to the other side
            continue
        np.testing.assert_allclose(cloud.xyz[i], mean[:3], atol=2e-6)
        assert (np.abs(cloud.rgb[i] - mean[3:6]) <= 0.51).all()
        np.testing.assert_allclose(cloud.normal[i], mean[6:] / np.linalg.norm(mean[6:]), atol=1e-4)


def test_the_same_frames_again_change_neither_the_number_of_points_nor_the_points() -> None:
    depth = noisy(plane_depth(CAMERA, unit(0.2, 0.1, -1), 1.5), np.random.default_rng(0))
    rgb = np.full((120, 160, 3), 99, np.uint8)
    once, often = VoxelCloud(0.02), VoxelCloud(0.02)
    once.add(see(depth), rgb, np.eye(4))
    rows = []
    for _ in range(5):
        often.add(see(depth), rgb, np.eye(4))
        rows.append(len(often._rows.index.row_key))
    np.testing.assert_allclose(once.cloud().xyz, often.cloud().xyz, atol=1e-5)
    assert rows[4] == rows[1]
    assert len(once.cloud(min_points=5)) < len(often.cloud(min_points=5)) == len(once.cloud())


def test_an_empty_cloud_is_a_cloud() -> None:
    cloud = VoxelCloud(0.01).cloud(neighbours=8, max_deviation=2.0).moved(np.eye(4))
    assert len(cloud) == 0 and cloud.rgb.dtype == np.uint8


def test_points_beyond_the_maps_border_are_left_out() -> None:
    T_far = np.eye(4)
    T_far[:3, 3] = 1e6
    model = VoxelCloud(0.01)
    model.add(see(np.full((120, 160), 2.0, np.float32)), np.zeros((120, 160, 3), np.uint8), T_far)
    assert len(model.cloud()) == 0


def test_moving_a_cloud_moves_points_and_turns_normals() -> None:
    model = VoxelCloud(0.02)
    model.add(see(np.full((120, 160), 2.0, np.float32)), np.zeros((120, 160, 3), np.uint8), np.eye(4))
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 0.5]))
    cloud, moved = model.cloud(), model.cloud().moved(T)
    np.testing.assert_allclose(moved.xyz, se3.transform(T, cloud.xyz.astype(np.float64)), atol=1e-5)
    np.testing.assert_allclose(moved.normal, cloud.normal @ T[:3, :3].T, atol=1e-6)


# Stray points


def distances(xyz: np.ndarray, reach: float, neighbours: int) -> np.ndarray:
    apart = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.minimum(np.sort(apart, axis=1)[:, :neighbours], reach).mean(axis=1)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_strays_are_those_of_the_slow_twin(seed: int, neighbours: int) -> None:
    from slamcli.geometry import voxel

    rng = np.random.default_rng(seed)
    cell = rng.integers(-12, 12, (300, 3)) * [1, 1, 0] + rng.integers(-1, 2, (300, 3))
    cell = np.unique(np.vstack([cell, rng.integers(-30, 30, (6, 3))]), axis=0)
    key = voxel.morton(cell + outlier_removal.HALF_EXTENT)
    order = np.argsort(key)
    cell, key = cell[order], key[order]
    xyz = (cell + rng.uniform(0, 1, cell.shape)) * 0.01
    padded = np.vstack([xyz, np.full((9, 3), 1e3)])  # at least nine others, all beyond reach
    expected = distances(padded, 0.04, neighbours)[: len(xyz)]
    keep = outlier_removal.not_stray(xyz.astype(np.float32), key, side=0.01, neighbours=neighbours, max_deviation=1.0)
    limit = expected.mean() + expected.std()
    clear = np.abs(expected - limit) > 1e-5
    assert (keep == (expected <= limit))[clear].all()


def test_points_in_the_air_are_dropped_and_a_wall_is_kept() -> None:
    model = VoxelCloud(0.02)
    rgb = np.zeros((120, 160, 3), np.uint8)
    wall = see(np.full((120, 160), 2.0, np.float32), spacing=0.02)
    model.add(wall, rgb, np.eye(4))
    stray = np.float32([[0.1, 0.1, 1.0], [-0.4, 0.2, 1.3], [0.3, -0.2, 0.8]])
    model.add(Surface(np.arange(3, dtype=np.int32), stray, np.tile(np.float32([0, 0, -1]), (3, 1)), np.ones(3, np.float32)), rgb, np.eye(4))
    cloud = model.cloud(neighbours=8, max_deviation=3.0)
    assert cloud.xyz[:, 2].min() > 1.99
    assert len(cloud) > 0.99 * (len(model.cloud()) - 3)
    assert len(model.cloud()) - len(cloud) >= 3
