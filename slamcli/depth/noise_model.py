"""What a measurement is worth: the standard deviations that the options of `sensor` stand for."""

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.geometry import elementary
from slamcli.geometry.depth_noise import DepthNoise


def reading_noise(sensor: SensorConfig) -> DepthNoise:
    """Return the noise of a single depth reading: what tells a surface from a step in one depth image, or in two aligned ones."""
    return DepthNoise(float(sensor.reading_noise_base), float(sensor.reading_noise_quadratic))


def depth_noise(sensor: SensorConfig) -> DepthNoise:
    """Return the noise of a depth in the map, the errors of calibration and poses with it: what key points and grid cells rest on."""
    return DepthNoise(float(sensor.depth_noise_base), float(sensor.depth_noise_quadratic))


def pixel_sigma(octave: np.ndarray, *, pixel_noise: float, octave_scale: float) -> np.ndarray:
    """Return the standard deviation of key points [px]: it grows with the size of the patch they were found in."""
    return pixel_noise * elementary.power(octave_scale, octave)
