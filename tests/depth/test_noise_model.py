"""The simulated sensor against its published figures."""

import numpy as np
import pytest

from slamcli.datasets.simulated.noise import NormalNoise, SensorNoise, colour_noise, depth_noise, in_projector_shadow

SHAPE = (120, 160)
SENSOR = SensorNoise()


def noisy(depth: np.ndarray, cosine: float = 1.0, **changes: float) -> np.ndarray:
    rng = np.random.default_rng(3)
    sensor = SensorNoise(**changes) if changes else SENSOR
    return depth_noise(depth.astype(np.float32), np.full(SHAPE, cosine, np.float32), 525.0, sensor, NormalNoise(SHAPE, 1), rng)


@pytest.mark.parametrize("z", [0.6, 1.0, 2.0, 3.0, 4.0])
def test_axial_noise_grows_as_published(z: float) -> None:
    error = noisy(np.full(SHAPE, z)) - z
    published = SENSOR.axial_base + SENSOR.axial_quadratic * (z - 0.4) ** 2
    step = z * z * SENSOR.disparity_step / (SENSOR.baseline * SENSOR.disparity_focal)
    expected = np.hypot(published, step / np.sqrt(12))
    assert 0.8 * expected < error.std() < 1.25 * expected
    assert abs(error.mean()) < 0.5 * step


def test_readings_come_in_steps_of_disparity() -> None:
    values = np.unique(noisy(np.full(SHAPE, 2.0)))
    disparity = SENSOR.baseline * SENSOR.disparity_focal / SENSOR.disparity_step / values
    np.testing.assert_allclose(disparity, np.round(disparity), atol=1e-3)
    assert 2 < len(values) < 30


def test_range_limits_and_grazing_angles_leave_holes() -> None:
    assert (noisy(np.full(SHAPE, 0.3)) == 0).all() and (noisy(np.full(SHAPE, 6.0)) == 0).all()
    assert (noisy(np.full(SHAPE, 2.0), cosine=0.03) == 0).mean() > 0.98
    assert (noisy(np.full(SHAPE, 2.0), cosine=0.4) > 0).all()
    assert (noisy(np.full(SHAPE, 1.0), near=1.2) == 0).mean() > 0.99


def test_something_near_casts_its_shadow_to_the_left_of_itself() -> None:
    depth = np.full(SHAPE, 3.0, dtype=np.float32)
    depth[:, 100:120] = 1.0
    shadow = in_projector_shadow(depth, 525.0 * 0.075)
    width = 525.0 * 0.075 * (1 / 1.0 - 1 / 3.0)  # difference of the two disparities, 26 px
    columns = np.flatnonzero(shadow[50])
    assert columns.max() < 100 and abs(len(columns) - width) < 3
    assert not in_projector_shadow(np.full(SHAPE, 2.0, dtype=np.float32), 40.0).any()


def test_edges_lose_their_reading() -> None:
    depth = np.full(SHAPE, 2.0)
    depth[:, 80:] = 3.0  # farther to the right: no shadow, only an edge
    lost = noisy(depth) == 0
    assert lost[:, 79:81].all() and not lost[:, :70].any() and not lost[:, 90:].any()


def test_colour_noise_has_its_sigma_and_clips() -> None:
    rng, normal = np.random.default_rng(0), NormalNoise(SHAPE, 2)
    picture = colour_noise(np.full((*SHAPE, 3), 100.0, np.float32), SENSOR, normal, rng)
    assert picture.dtype == np.uint8 and abs(picture.astype(float).mean() - 100) < 0.2 and 1.4 < picture.std() < 1.9
    assert colour_noise(np.full((*SHAPE, 3), 300.0, np.float32), SENSOR, normal, rng).min() == 255


def test_noise_is_a_function_of_the_generator() -> None:
    depth = np.full(SHAPE, 2.0)
    assert np.array_equal(noisy(depth), noisy(depth))
