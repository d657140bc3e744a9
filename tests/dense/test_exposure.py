"""Gains that were put on frames are found again, from the surfaces that the frames share."""

import numpy as np
import pytest

from slamcli.dense import exposure
from slamcli.depth.oriented_points import Surface

SIDE = 60  # pixels


def frames(gains, *, seed=0, noise=1.5, apart=0.4, shading=1.0):
    """Frames that look at one painted wall, each further along it, under gains (K, 3) and a lens that darkens by `shading` (H, W, 1)."""
    rng = np.random.default_rng(seed)
    paint = rng.uniform(40, 170, (200, 100, 3))
    made = []
    for k, gain in enumerate(gains):
        T = np.eye(4)
        T[0, 3] = apart * k
        v, u = np.divmod(np.arange(SIDE * SIDE), SIDE)
        x, y = 0.03 * (u + 0.5), 0.03 * (v + 0.5)  # a pixel is a voxel wide
        column = np.floor((x + T[0, 3]) / 0.03).astype(int) % 200
        rgb = (paint[column, v] * gain).reshape(SIDE, SIDE, 3) * shading
        rgb = rgb.reshape(-1, 3) + rng.normal(0, noise, (SIDE * SIDE, 3))
        rgb[rng.random(SIDE * SIDE) < 0.05] = rng.uniform(20, 200, 3)  # something passes by
        xyz = np.column_stack([x, y, np.full(len(x), 1.015)]).astype(np.float32)
        seen = Surface(
            np.arange(SIDE * SIDE, dtype=np.int32), xyz, np.tile(np.float32([0, 0, -1]), (len(x), 1)), np.ones(len(x), np.float32)
        )
        made.append((seen, np.clip(np.rint(rgb), 0, 255).astype(np.uint8).reshape(SIDE, SIDE, 3), T))
    return made


def gains_of(seen):
    return np.exp(exposure.fit_evening(seen).gain)


def dark_corners(loss):
    """The share of light (SIDE, SIDE, 1) that a lens lets through which loses `loss` in the corners, by the fourth power of a cosine."""
    v, u = np.mgrid[:SIDE, :SIDE] - 0.5 * (SIDE - 1)
    square = (u * u + v * v) / (0.5 * (SIDE - 1) ** 2)
    return (1.0 / (1.0 + square * ((1.0 - loss) ** -0.5 - 1.0)) ** 2)[..., None]


@pytest.mark.parametrize("loss", [0.0, 0.15, 0.4])
def test_vignetting_is_found_beside_gains_and_taken_off(loss):
    true, shading = np.exp(np.random.default_rng(1).normal(0, 0.1, (12, 3))), dark_corners(loss)
    seen = frames(true, shading=shading, apart=0.3)
    found = exposure.fit_evening(seen)
    evened_light = np.log(found.shading(SIDE, SIDE) * shading)
    assert np.abs(evened_light - evened_light.mean(axis=(0, 1))).max() < 0.03
    images = [exposure.evened(rgb, gain, found.shading(SIDE, SIDE)) for (_, rgb, _), gain in zip(seen, found.gain, strict=True)]
    a, b = (images[k][:, cut].astype(float) for k, cut in ((5, slice(10, None)), (6, slice(None, -10))))  # 0.3 m is ten columns
    assert np.median(np.abs(a - b)) < 3.0
    assert np.mean([image.mean() for image in images]) == pytest.approx(np.mean([rgb.mean() for _, rgb, _ in seen]), rel=0.03)


def test_the_gains_put_on_frames_are_taken_off_again():
    true = np.exp(np.random.default_rng(1).normal(0, 0.15, (12, 3)))
    found = gains_of(frames(true))
    relative = np.log(found * true)
    assert np.abs(relative - relative.mean(axis=0)).max() < 0.01
    np.testing.assert_allclose(np.log(found).mean(axis=0), 0.0, atol=0.02)


def test_equal_frames_stay_as_they_are_and_a_long_row_of_them_does_not_drift():
    found = gains_of(frames(np.ones((40, 3))))
    assert np.abs(found - 1.0).max() < 0.01


def test_frames_that_share_nothing_and_frames_without_colour_keep_theirs():
    found = gains_of(frames(np.array([[1.0, 1.0, 1.0], [1.3, 1.3, 1.3]]), apart=3.0))
    np.testing.assert_allclose(found, 1.0, atol=1e-6)
    dark = [(seen, np.zeros_like(rgb), T) for seen, rgb, T in frames(np.ones((3, 3)))]
    np.testing.assert_allclose(gains_of(dark), 1.0)
    assert gains_of([]).shape == (0, 3)


def test_the_fit_is_the_least_squares_solution():
    """Against numpy's solver with every voxel's colour as an unknown, on samples without outliers."""
    rng = np.random.default_rng(2)
    of_frame, of_voxel = np.nonzero(rng.random((5, 60)) < 0.6)
    true, colour, slope = rng.normal(0, 0.2, 5), rng.uniform(3, 5, 60), np.array([0.3, -0.2, 0.1])
    radial = rng.random((len(of_frame), 1)) ** np.array([1, 2, 3])
    value = colour[of_voxel] - true[of_frame] - radial @ slope
    found = exposure.fit_logarithms(of_frame, of_voxel, value[:, None], radial, n_frames=5)
    A = np.zeros((len(value) + 8, 68))
    A[np.arange(len(value)), of_frame], A[np.arange(len(value)), 8 + of_voxel] = 1.0, -1.0
    A[: len(value), 5:8] = radial
    A[len(value) + np.arange(8), np.arange(8)] = exposure.PRIOR * exposure.NOISE
    expected = np.linalg.lstsq(A, np.append(-value, np.zeros(8)), rcond=None)[0]
    gain = found.gain[:, 0] - found.gain[:, 0].mean()
    np.testing.assert_allclose(gain, expected[:5] - expected[:5].mean(), atol=2e-3)
    np.testing.assert_allclose(gain, true - true.mean(), atol=5e-3)
    bent, solved, given = ((radial - radial.mean(axis=0)) @ np.column_stack([found.falloff[0], expected[5:8], slope])).T
    np.testing.assert_allclose(bent, solved, atol=0.01)
    np.testing.assert_allclose(bent, given, atol=0.02)  # the prior holds 184 samples back a little
    assert np.ptp(given) > 0.15


def test_an_image_under_gains_and_shading():
    rgb = np.array([[[0, 100, 255], [0, 100, 200]]], np.uint8)
    flat = np.ones((1, 1, 3), np.float32)
    assert exposure.evened(rgb, np.log([2.0, 1.5, 1.1]), flat).tolist() == [[[0, 150, 255], [0, 150, 220]]]
    assert exposure.evened(rgb, np.zeros(3), flat).tolist() == rgb.tolist()
    assert exposure.evened(rgb, np.zeros(3), np.float32([[[1, 1, 1], [1, 2, 1]]])).tolist() == [[[0, 100, 255], [0, 200, 200]]]


@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_frames_give_the_same_gains(seed):
    a, b = (gains_of(frames(np.ones((4, 3)), seed=seed)) for _ in range(2))
    assert a.tobytes() == b.tobytes()
