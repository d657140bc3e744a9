"""g2o's convention for the information of an edge between two poses.

Here an information belongs to the left twist xi = (rho, phi) of T_ij: T_ij_true = exp(xi) T_ij. g2o's error is that of a motion on the
right of T_ij, its rotation given by the vector part of a quaternion x y z w, which is half the angle.
"""

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.algebra import product

TO_QUATERNION = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


def to_g2o_information(T_ij: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Turn the information (..., 6, 6) of left twists of T_ij (..., 4, 4) into that of g2o's error."""
    to_left = se3.adjoint(T_ij) * TO_QUATERNION
    return product(np.swapaxes(to_left, -1, -2), information, to_left)


def from_g2o_information(T_ij: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Undo `to_g2o_information`."""
    to_right = se3.adjoint(se3.inverse(T_ij)) / TO_QUATERNION[:, None]
    return product(np.swapaxes(to_right, -1, -2), information, to_right)
