"""A Kinect of full size, and its noise on depth images."""

import numpy as np

from slamcli.datasets.simulated.noise import NormalNoise, SensorNoise, depth_noise
from slamcli.geometry.camera import Camera

KINECT = Camera(640, 480, 570.0, 570.0, 319.5, 239.5)


def noisy(depth: np.ndarray, seed: int) -> np.ndarray:
    rng, normal = np.random.default_rng(seed), NormalNoise(depth.shape, seed)
    read = depth_noise(np.nan_to_num(depth, nan=99.0), np.ones_like(depth), KINECT.fx, SensorNoise(), normal, rng)
    return np.where(read > 0.0, read, np.nan).astype(np.float32)
