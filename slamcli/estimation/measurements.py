"""What features measured, and how well: the input of every estimate of a pose from landmarks."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Measurements:
    """Where features were seen, row by row, with standard deviations."""

    xy: np.ndarray  # (N, 2) px, undistorted
    depth: np.ndarray  # (N,) m, NaN where there is none or it is not trusted
    sigma_px: np.ndarray  # (N,) px
    sigma_z: np.ndarray  # (N,) m, NaN where depth is

    def take(self, rows: np.ndarray) -> "Measurements":
        """Return some of the rows."""
        return Measurements(*(column.take(rows, axis=0) for column in (self.xy, self.depth, self.sigma_px, self.sigma_z)))
