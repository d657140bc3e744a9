"""The formula of depth noise: one place for it, and each kind of noise set by its own options."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import slamcli
from slamcli.config.options import SensorConfig
from slamcli.depth import noise_model
from slamcli.geometry import depth_noise
from slamcli.geometry.depth_noise import DepthNoise

PACKAGE = Path(slamcli.__file__).parent
NUMBERS = st.floats(0.0, 1.0)


@given(st.floats(0.0, 20.0), st.builds(DepthNoise, NUMBERS, NUMBERS))
def test_kernel_and_array_form_give_the_same_bits_and_nothing_below_the_base(z: float, noise: DepthNoise) -> None:
    one = depth_noise.sigma.py_func(z, noise)
    assert one == depth_noise.sigmas(np.array([z]), noise)[0]
    assert noise.base <= one <= noise.base + noise.quadratic * 20.0**2
    assert depth_noise.sigma.py_func(depth_noise.BEST, noise) == noise.base


def test_a_kinect_reads_as_published() -> None:
    sigma = depth_noise.sigmas(np.array([0.4, 1.4, 3.4, np.nan]), noise_model.reading_noise(SensorConfig()))
    np.testing.assert_allclose(sigma, [0.0012, 0.0031, 0.0183, np.nan])


@pytest.mark.parametrize("name", ["reading_noise", "depth_noise"])
def test_each_kind_of_noise_has_options_of_its_own(name: str) -> None:
    sensor = SensorConfig(**{f"{name}_base": 0.5, f"{name}_quadratic": 0.25})
    other = {"reading_noise": noise_model.depth_noise, "depth_noise": noise_model.reading_noise}[name]
    assert getattr(noise_model, name)(sensor) == DepthNoise(0.5, 0.25)
    assert other(sensor) == other(SensorConfig())


def test_the_formula_is_written_once() -> None:
    """The simulated sensor has its own: it is what the model is judged by."""
    written = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py") if "- 0.4)" in path.read_text(encoding="utf-8")}
    assert written == {"datasets/simulated/noise.py"}
