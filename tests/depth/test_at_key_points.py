"""What a depth image says at key points, on surfaces whose depth is known in closed form."""

import numpy as np

from slamcli.depth import at_key_points


def test_depth_is_the_nearest_pixels_or_the_median_of_a_square() -> None:
    depth = np.full((7, 8), np.nan, dtype=np.float32)
    depth[2:5, 2:5] = [[1, 2, 3], [4, np.nan, 5], [6, 7, 8]]
    depth[6, 7] = 9
    xy = np.array([[3.3, 2.8], [1.6, 2.2], [6.9, 6.2], [0.0, 6.0]], dtype=np.float32)
    np.testing.assert_array_equal(at_key_points.depth_at(depth, xy), [np.nan, 1, 9, np.nan])
    np.testing.assert_array_equal(at_key_points.depth_at(depth, xy, window=3), [4, 2, 9, np.nan])


def behind(depth: np.ndarray, at: np.ndarray, *, jump: float, scale: float = 1.0) -> np.ndarray:
    return at_key_points.is_behind_outline(depth, at, np.full(len(at), scale), jump=jump)


def test_what_is_behind_an_outline_is_told_from_the_outline_a_slope_a_fold_and_a_hole() -> None:
    v, u = np.mgrid[:60, :640].astype(float)
    slope = 1.0 / (0.2 + 0.004 * u + 0.001 * v)  # a plane: 5 m on the left, 1.9 m on the right
    fold = 1.0 / (0.4 + 0.002 * np.abs(u - 40))
    step = np.where(u < 40, 2.0, 2.3)
    at = np.array([[x, 30.0] for x in (20.0, 36.0, 37.4, 40.0, 42.0, 43.0, 60.0)])
    assert not behind(slope, at, jump=0.05).any() and not behind(fold, at, jump=0.05).any()
    np.testing.assert_array_equal(behind(step, at, jump=0.05), [False, False, False, True, True, False, False])
    assert not behind(step, at, jump=0.2).any()
    corner = np.where((u < 40) & (v < 30), 2.0, 3.0)
    assert behind(corner, np.array([[38.0, 28.0], [41.0, 31.0], [41.0, 20.0]]), jump=0.05).tolist() == [
        False,
        True,
        True,
    ]
    step[28:33, 30:34] = np.nan
    assert not behind(step, np.array([[28.0, 30.0], [32.0, 30.0]]), jump=0.05).any()


def test_an_outline_is_looked_for_as_far_as_a_corner_of_the_points_octave_reaches() -> None:
    u = np.mgrid[:60, :640][1]
    step, fold = np.where(u < 40, 1.2, 2.0), 1.0 / (0.4 + 0.002 * np.abs(u - 40))
    at = np.array([[x, 30.0] for x in range(30, 60)])
    for octave in range(8):
        scale = 1.2**octave
        is_behind = behind(step, at, jump=0.05, scale=scale)
        assert np.flatnonzero(is_behind).tolist() == list(range(10, 10 + round(3 * scale)))
        assert not behind(fold, at, jump=0.05, scale=scale).any()


def test_a_pole_nearer_than_the_farthest_that_is_looked_at_is_an_outline_too() -> None:
    u = np.mgrid[:60, :640][1]
    pole = np.where((u >= 38) & (u < 41), 1.2, 2.0)
    at = np.array([[46.0, 30.0], [33.0, 30.0], [60.0, 30.0]])
    assert behind(pole, at, jump=0.05, scale=3.6).tolist() == [True, True, False] and not behind(pole, at, jump=0.05).any()


def test_the_slope_of_a_plane_is_exact_up_to_the_border_and_past_holes() -> None:
    v, u = np.mgrid[:60, :640].astype(float)
    plane = (1.0 / (0.5 + 0.0008 * u - 0.002 * v)).astype(np.float32)
    plane[::3, ::4] = np.nan
    at = np.array([[3.0, 2.0], [301.2, 30.4], [637.0, 56.0], [301.0, 2.0], [5.0, 41.0]])
    slope = at_key_points.inverse_depth_slope(plane, at)
    assert slope.dtype == np.float32 and np.isfinite(plane[np.rint(at[:, 1]).astype(int), np.rint(at[:, 0]).astype(int)]).all()
    np.testing.assert_allclose(slope, np.tile([0.0008, -0.002], (5, 1)), rtol=0.02)


def test_beside_an_outline_the_slope_is_that_of_the_points_own_surface() -> None:
    v, u = np.mgrid[:60, :640].astype(float)
    scene = np.where(u < 40, 1.0 / (0.5 + 0.003 * v), 1.0 / (0.2 + 0.001 * u))
    slope = at_key_points.inverse_depth_slope(scene, np.array([[38.0, 30.0], [42.0, 30.0]]))
    np.testing.assert_allclose(slope, [[0.0, 0.003], [0.001, 0.0]], atol=1e-5)


def test_a_direction_in_which_nothing_is_shown_is_taken_to_be_level() -> None:
    depth = np.full((30, 640), np.nan, dtype=np.float32)
    depth[10, 10] = 2.0
    depth[12, 290:311] = 1.0 / (0.5 + 0.001 * np.arange(-10, 11))
    at = np.array([[10.0, 10.0], [300.0, 12.0], [0.0, 0.0], [500.0, 20.0]])  # alone; on a line; in a corner without depth; no depth
    slope = at_key_points.inverse_depth_slope(depth, at)
    np.testing.assert_allclose(slope, [[0.0, 0.0], [0.001, 0.0], [0.0, 0.0], [0.0, 0.0]], atol=2e-5)
    assert at_key_points.inverse_depth_slope(depth, np.zeros((0, 2))).shape == (0, 2)


def test_the_slope_of_a_noisy_plane_is_unbiased_and_far_more_certain_than_neighbouring_pixels_are() -> None:
    rng = np.random.default_rng(0)
    u = np.mgrid[:480, :640][1].astype(float)
    sigma = 0.004
    noisy = 1.0 / (0.5 + 0.0004 * u) + rng.normal(0, sigma, (480, 640))
    at = np.stack([rng.uniform(20, 620, 2000), rng.uniform(20, 460, 2000)], axis=1)
    slope = at_key_points.inverse_depth_slope(noisy, at)[:, 0]
    z = 1.0 / (0.5 + 0.0004 * at[:, 0])
    per_px = sigma / z**2
    assert abs(np.mean(slope - 0.0004)) < 0.05 * np.mean(per_px)
    assert 0.002 * np.mean(per_px) < np.std(slope - 0.0004) < 0.03 * np.mean(per_px)


def test_outlines_are_told_as_by_the_slow_twin_at_every_pixel() -> None:
    rng = np.random.default_rng(0)
    depth = (2.0 + np.cumsum(rng.normal(0, 0.02, (40, 50)), axis=1) + (rng.random((40, 50)) < 0.05)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = np.nan
    row, column = (axis.ravel() for axis in np.mgrid[:40, :50])

    def inverse(down: int, right: int) -> np.ndarray:
        return np.float32(1.0) / depth[np.clip(row + 3 * down, 0, 39), np.clip(column + 3 * right, 0, 49)]

    bend = [inverse(d, r) + inverse(-d, -r) - 2 * inverse(0, 0) for d, r in ((0, 1), (1, 0), (1, 1), (1, -1))]
    expected = (np.array(bend) > np.float32(0.05 * 640 / 50) * inverse(0, 0)).any(axis=0)
    found = behind(depth, np.stack([column, row], axis=1).astype(np.float32), jump=0.05)
    assert 50 < expected.sum() < 1500
    np.testing.assert_array_equal(found, expected)
