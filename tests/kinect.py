"""A Kinect of full size, its noise on depth images, and coarse images in the code in which a recording's are kept."""

from collections.abc import Sequence

import numpy as np

from slamcli.datasets.simulated.noise import NormalNoise, SensorNoise, depth_noise
from slamcli.depth.coarse_images import CoarseImages, encode
from slamcli.geometry.camera import Camera

KINECT = Camera(640, 480, 570.0, 570.0, 319.5, 239.5)


def noisy(depth: np.ndarray, seed: int) -> np.ndarray:
    rng, normal = np.random.default_rng(seed), NormalNoise(depth.shape, seed)
    read = depth_noise(np.nan_to_num(depth, nan=99.0), np.ones_like(depth), KINECT.fx, SensorNoise(), normal, rng)
    return np.where(read > 0.0, read, np.nan).astype(np.float32)


def coded(images: Sequence[np.ndarray]) -> CoarseImages:
    """Encode coarse depth images as extract does."""
    return CoarseImages(encode(images, images[0].shape))
