"""Even out the camera's exposure and white balance: one gain per frame and channel, from the surfaces that frames share.

The logarithms of all gains are one robust least squares fit: in each voxel, the frames that see it should agree on its colour. The voxels'
own colours are eliminated. After M. Brown, D. Lowe, IJCV 2007, section 6, doi:10.1007/s11263-006-0002-3, with a voxel in place of an overlap.
"""

from collections.abc import Iterable

import numpy as np
from scipy import sparse

from slamcli.depth.oriented_points import Surface
from slamcli.geometry import elementary, se3, voxel
from slamcli.geometry.algebra import solve

SIDE = 0.03  # [m] of a voxel
MOST_SAMPLES = 4000  # compared per frame
DARKEST, BRIGHTEST = 12, 245  # grey levels: beyond them the sensor no longer tells how much light there was
PRIOR = 1.0 / 0.4054651081081644  # 1 / log 1.5: a gain differs from 1 by a half either way, as one sample's worth of evidence
NOISE = 0.1  # of a logarithm: texture within a voxel, shading
ROUNDS = 6  # of re-weighting
TUKEY = 4.685  # robust deviations at which a sample no longer counts, for 95 % efficiency
MAD = 1.4826  # standard deviations in a median of absolute deviations
LEAST_DEVIATION, LEAST_WEIGHT = 1e-3, 1e-4  # of a logarithm, and of a sample: the fit stays determined
HALF_EXTENT = 1 << 20  # voxels


def frame_gains(frames: Iterable[tuple[Surface, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Find the gains (K, 3) by which frames' channels are to be multiplied so that they agree; their geometric mean is 1.

    frames : per frame what it saw, its colours (H, W, 3) uint8, and its pose (4, 4), camera to world
    """
    key, log_colour = _samples(frames)
    n_frames = len(key)
    counts = np.array([len(k) for k in key])
    if n_frames == 0 or counts.sum() == 0:
        return np.ones((n_frames, 3))
    of_frame = np.repeat(np.arange(n_frames), counts)
    of_voxel = np.unique(np.concatenate(key), return_inverse=True)[1]
    return elementary.exp(fit_log_gains(of_frame, of_voxel, np.concatenate(log_colour), n_frames=n_frames))


def _samples(frames: Iterable[tuple[Surface, np.ndarray, np.ndarray]]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Collect each frame's voxels, each once, with the mean logarithm of its colours there."""
    key, log_colour = [], []
    for seen, rgb, T_wc in frames:
        every = max(1, len(seen.pixel) // (4 * MOST_SAMPLES))
        colour = rgb.reshape(-1, 3)[seen.pixel[::every]]
        is_told = (colour.min(axis=1, initial=255) >= DARKEST) & (colour.max(axis=1, initial=0) <= BRIGHTEST)
        xyz = se3.transform(T_wc, seen.xyz_c[::every][is_told].astype(np.float64))
        cell = np.floor(xyz / SIDE).astype(np.int64) + HALF_EXTENT
        inside = ((cell >= 0) & (cell < 2 * HALF_EXTENT)).all(axis=1)
        cells, row = np.unique(voxel.morton(cell[inside]), return_inverse=True)
        logs = elementary.log(colour[is_told][inside].astype(np.float64))
        total = np.column_stack([np.bincount(row, weights=logs[:, k], minlength=len(cells)) for k in range(3)])
        mean = total / np.maximum(np.bincount(row, minlength=len(cells)), 1)[:, None]
        step = max(1, -(-len(cells) // MOST_SAMPLES))
        # Whole families of voxels are taken, not every so many rows: other frames must take the same ones.
        kept = (cells * 2654435761 >> 16) % step == 0
        key.append(cells[kept])
        log_colour.append(mean[kept].astype(np.float32))
    return key, log_colour


def fit_log_gains(of_frame: np.ndarray, of_voxel: np.ndarray, log_colour: np.ndarray, *, n_frames: int) -> np.ndarray:
    """Fit the logarithms (K, 3) of gains to samples (N,) of frames in voxels with the logarithms of their colours (N, 3).

    Minimizes sum w (log_colour + gain - colour of the voxel)^2, Tukey's weights, plus a weak prior that keeps frames without overlap at 1.
    """
    n_voxels = int(of_voxel.max(initial=-1)) + 1
    gain = np.zeros((n_frames, log_colour.shape[1]))
    for channel in range(gain.shape[1]):
        value = log_colour[:, channel].astype(np.float64)
        weight = np.full(len(value), 1.0 / NOISE**2)
        for _ in range(ROUNDS):
            M = sparse.csr_matrix((weight, (of_frame, of_voxel)), shape=(n_frames, n_voxels))
            per_voxel = np.maximum(np.asarray(M.sum(axis=0)).ravel(), 1e-12)
            A = np.diag(np.asarray(M.sum(axis=1)).ravel() + PRIOR**2) - (M @ sparse.diags(1.0 / per_voxel) @ M.T).toarray()
            mean = np.bincount(of_voxel, weights=weight * value, minlength=n_voxels) / per_voxel
            b = np.bincount(of_frame, weights=weight * (mean[of_voxel] - value), minlength=n_frames)
            gain[:, channel] = solve(A, b)
            evened = value + gain[of_frame, channel]
            middle = np.bincount(of_voxel, weights=weight * evened, minlength=n_voxels) / per_voxel
            residual = np.abs(evened - middle[of_voxel])
            scale = TUKEY * max(MAD * float(np.median(residual)), LEAST_DEVIATION)
            weight = np.square(np.maximum(1.0 - np.square(residual / scale), LEAST_WEIGHT)) / NOISE**2
    return gain - gain.mean(axis=0)


def evened(rgb: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Multiply an image (H, W, 3) uint8 by the gains (3,) of its channels."""
    table = np.clip(np.rint(np.arange(256)[:, None] * gain), 0, 255).astype(np.uint8)
    return np.stack([table[rgb[..., k], k] for k in range(3)], axis=-1)
