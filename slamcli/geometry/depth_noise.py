"""The one formula of a depth camera's noise: a standard deviation that grows with the square of the distance."""

from typing import NamedTuple

import numpy as np

from slamcli.jit.kernel import kernel

BEST = 0.4  # [m] where structured light measures best


class DepthNoise(NamedTuple):
    """Standard deviation of a depth z as base + quadratic (z - 0.4 m)^2.

    C. V. Nguyen, S. Izadi, D. Lovell, Modeling Kinect sensor noise, 3DIMPVT 2012, equation (2): 0.0012 m and 0.0019 / m.
    """

    base: float  # [m] at 0.4 m
    quadratic: float  # [1/m]


@kernel
def sigma(z, noise):
    """Return the standard deviation [m] of a depth z [m]."""
    beyond = z - BEST
    return noise.base + noise.quadratic * (beyond * beyond)


def sigmas(z: np.ndarray, noise: DepthNoise) -> np.ndarray:
    """Return the standard deviations [m] of depths z [m], NaN where there is none."""
    return noise.base + noise.quadratic * np.square(np.asarray(z, dtype=np.float64) - BEST)
