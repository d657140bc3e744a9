"""Pictures with texture everywhere."""

import cv2
import numpy as np


def texture(seed: int, height: int, width: int) -> np.ndarray:
    """Blobs, edges and noise; some pictures low in contrast, some saturated."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.normal(0, 1, (max(2, height // 6), max(2, width // 6))), (width, height), interpolation=cv2.INTER_CUBIC)
    grey = 128 + rng.choice([4, 40, 200]) * coarse + rng.normal(0, rng.choice([0.0, 3.0]), (height, width))
    return np.clip(grey, 0, 255).astype(np.uint8)
