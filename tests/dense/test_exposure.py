"""Gains that were put on frames are found again, from the surfaces that the frames share."""

import numpy as np
import pytest

from slamcli.dense import exposure
from slamcli.depth.oriented_points import Surface

SIDE = 60  # pixels


def frames(gains, *, seed=0, noise=1.5, apart=0.4):
    """Frames that look at one painted wall, each further along it, under gains (K, 3)."""
    rng = np.random.default_rng(seed)
    paint = rng.uniform(40, 170, (200, 100, 3))
    made = []
    for k, gain in enumerate(gains):
        T = np.eye(4)
        T[0, 3] = apart * k
        v, u = np.divmod(np.arange(SIDE * SIDE), SIDE)
        x, y = 0.03 * (u + 0.5), 0.03 * (v + 0.5)  # a pixel is a voxel wide
        column = np.floor((x + T[0, 3]) / 0.03).astype(int) % 200
        rgb = paint[column, v] * gain + rng.normal(0, noise, (SIDE * SIDE, 3))
        rgb[rng.random(SIDE * SIDE) < 0.05] = rng.uniform(20, 200, 3)  # something passes by
        xyz = np.column_stack([x, y, np.full(len(x), 1.015)]).astype(np.float32)
        seen = Surface(
            np.arange(SIDE * SIDE, dtype=np.int32), xyz, np.tile(np.float32([0, 0, -1]), (len(x), 1)), np.ones(len(x), np.float32)
        )
        made.append((seen, np.clip(np.rint(rgb), 0, 255).astype(np.uint8).reshape(SIDE, SIDE, 3), T))
    return made


def test_the_gains_put_on_frames_are_taken_off_again():
    true = np.exp(np.random.default_rng(1).normal(0, 0.15, (12, 3)))
    found = exposure.frame_gains(frames(true))
    relative = np.log(found * true)
    assert np.abs(relative - relative.mean(axis=0)).max() < 0.01
    np.testing.assert_allclose(np.log(found).mean(axis=0), 0.0, atol=1e-12)


def test_equal_frames_stay_as_they_are_and_a_long_row_of_them_does_not_drift():
    found = exposure.frame_gains(frames(np.ones((40, 3))))
    assert np.abs(found - 1.0).max() < 0.01


def test_frames_that_share_nothing_and_frames_without_colour_keep_theirs():
    found = exposure.frame_gains(frames(np.array([[1.0, 1.0, 1.0], [1.3, 1.3, 1.3]]), apart=3.0))
    np.testing.assert_allclose(found, 1.0, atol=1e-6)
    dark = [(seen, np.zeros_like(rgb), T) for seen, rgb, T in frames(np.ones((3, 3)))]
    np.testing.assert_allclose(exposure.frame_gains(dark), 1.0)
    assert exposure.frame_gains([]).shape == (0, 3)


def test_the_fit_is_the_least_squares_solution():
    """Against numpy's solver with every voxel's colour as an unknown, on samples without outliers."""
    rng = np.random.default_rng(2)
    of_frame, of_voxel = np.nonzero(rng.random((5, 60)) < 0.6)
    true, colour = rng.normal(0, 0.2, 5), rng.uniform(3, 5, 60)
    value = colour[of_voxel] - true[of_frame]
    found = exposure.fit_log_gains(of_frame, of_voxel, value[:, None], n_frames=5)[:, 0]
    A = np.zeros((len(value) + 1, 65))
    A[np.arange(len(value)), of_frame], A[np.arange(len(value)), 5 + of_voxel], A[-1, :5] = 1.0, -1.0, 1.0
    expected = np.linalg.lstsq(A, np.append(-value, 0.0), rcond=None)[0][:5]
    np.testing.assert_allclose(found, expected, atol=1e-3)
    np.testing.assert_allclose(found, true - true.mean(), atol=1e-3)


def test_an_image_under_gains():
    rgb = np.array([[[0, 100, 255]]], np.uint8)
    assert exposure.evened(rgb, np.array([2.0, 1.5, 1.1])).tolist() == [[[0, 150, 255]]]
    assert exposure.evened(rgb, np.ones(3)).tolist() == rgb.tolist()


@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_frames_give_the_same_gains(seed):
    a, b = (exposure.frame_gains(frames(np.ones((4, 3)), seed=seed)) for _ in range(2))
    assert a.tobytes() == b.tobytes()
