"""Poses weighed against the camera's motion relative to the background, where that is known beforehand (slam/background_motion.py)."""

from dataclasses import replace

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.algebra import inverse, product, solve
from slamcli.slam.local_map import MapMatch

# [1/m^2, 1/rad^2] of the background's motion: within 5 mm and 0.3 degrees from one frame to the next. Measured on hand-held recordings: 2 to
# 3 mm and 0.1 to 0.2 degrees in the median, nine in ten within 10 mm; longer steps hardly worse, as they are found over a third of a second.
BETWEEN_FRAMES, BETWEEN_KEY_FRAMES = 4e4 * np.eye(6), 4e4 * np.eye(6)
ENOUGH = 100  # landmarks that hold a pose without help
# Landmarks that are believed against the background's motion, which errs where a camera is shaken or sees little depth. What moves is masked
# by then; what is left of somebody who walks along are some tens.
MANY = 150
# Who walks along leaves the camera's motion by little from frame to frame, and by decimetres within this time; noise stays as it is.
LOOK_BACK = 0.35  # [s]
APART_M, APART_RAD = 0.01, 0.01  # by which poses may differ that were found from landmarks and from the background's motion, and
APART_SHARE = 0.1  # by which share of the motion: depth is measured at another time than colour, so a shaken camera shows two motions
CONTRADICTS_CHI2 = 30.0  # of six directions; the 99.99 % quantile is 28


def contradicts(found: MapMatch, expected: np.ndarray, T_wp: np.ndarray) -> bool:
    """Say whether a pose contradicts the one expected, T_cw (4, 4), by the background's motion since an earlier frame, T_wp (4, 4).

    The landmarks of somebody who walks along agree among themselves, a hundred of them as well as ten; MANY are believed.
    """
    if found.estimate.n_inliers >= MANY:
        return False
    motion, apart = se3.log(product(expected, T_wp)), _apart(expected, found.estimate.T_cw)
    least = np.repeat([APART_M, APART_RAD], 3)
    share = np.repeat([APART_SHARE * np.sqrt((part * part).sum()) for part in (motion[:3], motion[3:])], 3)
    covariance = inverse(found.estimate.information)
    covariance[np.diag_indices(6)] += least * least + share * share
    return bool((apart * solve(covariance, apart)).sum() > CONTRADICTS_CHI2)


def drawn(found: MapMatch, expected: np.ndarray) -> MapMatch:
    """Draw a pose that few landmarks hold towards the one expected, T_cw (4, 4), as far as what is known of both allows."""
    estimate = found.estimate
    if estimate.n_inliers >= ENOUGH:
        return found
    total = estimate.information + BETWEEN_FRAMES
    step = solve(total, product(BETWEEN_FRAMES, _apart(expected, estimate.T_cw)))
    return replace(found, estimate=replace(estimate, T_cw=product(se3.exp(step), estimate.T_cw), information=total))


def _apart(expected: np.ndarray, T_cw: np.ndarray) -> np.ndarray:
    return se3.log(product(expected, se3.inverse(T_cw)))
