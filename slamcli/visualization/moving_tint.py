"""What moves in an image, tinted."""

import numpy as np

from slamcli.geometry.camera import Camera
from slamcli.schema import Moving
from slamcli.slam import moving_objects

TINT, STRENGTH = np.array([230, 30, 120]), 0.5  # RGB, and its share in what is tinted


def tinted(rgb: np.ndarray, moving: Moving, frame: int, camera: Camera) -> np.ndarray:
    """Tint what moves in a frame's raw image (H, W, 3) uint8; the same image where nothing does."""
    if not len(moving.moving) or not moving.moving[frame].any():
        return rgb
    shows = moving_objects.in_image(np.asarray(moving.moving[frame]), camera)
    mixed = ((1.0 - STRENGTH) * rgb + STRENGTH * TINT).astype(np.uint8)
    return np.where(shows[..., None], mixed, rgb)
