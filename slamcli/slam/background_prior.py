"""Poses weighed against the camera's motion relative to the background, where that is known beforehand (slam/background_motion.py)."""

from dataclasses import replace

import numpy as np

from slamcli.geometry import se3
from slamcli.geometry.algebra import inverse, product, solve
from slamcli.slam.local_map import MapMatch

# [1/m^2, 1/rad^2] of the background's motion: within 3 mm and 0.2 degrees from one frame to the next, 5 mm and 0.3 between key frames.
# Measured: median 1.5 mm, nine in ten within 7 mm, and longer steps hardly worse, as they are found over a third of a second.
BETWEEN_FRAMES, BETWEEN_KEY_FRAMES = 1e5 * np.eye(6), 4e4 * np.eye(6)
CONTRADICTS_CHI2 = 30.0  # of six directions; the 99.99 % quantile is 28


def reconcile(found: MapMatch, expected: np.ndarray) -> MapMatch | None:
    """Draw a pose towards the one expected, T_cw (4, 4), as far as what is known of both allows; None where they contradict each other.

    The landmarks of somebody who walks along agree among themselves, a hundred of them as well as ten.
    """
    estimate = found.estimate
    apart = se3.log(product(expected, se3.inverse(estimate.T_cw)))
    both = inverse(inverse(estimate.information) + inverse(BETWEEN_FRAMES))
    if (apart * product(both, apart)).sum() > CONTRADICTS_CHI2:
        return None
    total = estimate.information + BETWEEN_FRAMES
    step = solve(total, product(BETWEEN_FRAMES, apart))
    return replace(found, estimate=replace(estimate, T_cw=product(se3.exp(step), estimate.T_cw), information=total))
