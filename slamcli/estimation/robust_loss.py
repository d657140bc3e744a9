"""When a residual is too large for its noise: quantiles of chi2, and Huber's loss, which begins to doubt an observation there."""

from typing import NamedTuple

import numpy as np

# Quantiles of chi2, of so many residuals over their standard deviations: a true observation stays below them with 95 or 99 %.
CHI2_95_2DOF = 5.991  # a pixel
CHI2_95_3DOF = 7.815  # a pixel and its depth
CHI2_95_6DOF = 12.592  # a relative pose
CHI2_99_6DOF = 16.81


class Huber(NamedTuple):
    """The chi2 from which an observation's cost grows like its root; below, it is chi2. P. Huber 1964, doi:10.1214/aoms/1177703732."""

    pixel: float = CHI2_95_2DOF  # of an observation without depth
    with_depth: float = CHI2_95_3DOF

    @property
    def is_robust(self) -> bool:
        """Say whether there is any chi2 from which it grows more slowly."""
        return bool(np.isfinite(self).all())


HUBER = Huber()
LEAST_SQUARES = Huber(np.inf, np.inf)
