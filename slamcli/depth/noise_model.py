"""What a measurement is worth: the sensor's noise as standard deviations."""

import numpy as np

from slamcli.geometry import elementary


def pixel_sigma(octave: np.ndarray, *, pixel_noise: float, octave_scale: float) -> np.ndarray:
    """Return the standard deviation of key points [px]: it grows with the size of the patch they were found in."""
    return pixel_noise * elementary.power(octave_scale, octave)


def depth_sigma(depth: np.ndarray, *, base: float, quadratic: float) -> np.ndarray:
    """Return the standard deviation of a structured-light depth reading [m], NaN where there is none.

    C. V. Nguyen, S. Izadi, D. Lovell, Modeling Kinect sensor noise, 3DIMPVT 2012, equation (2): 0.0012 + 0.0019 (z - 0.4)^2.
    """
    return base + quadratic * np.square(np.asarray(depth, dtype=np.float64) - 0.4)
