"""Even out the camera's exposure, white balance and vignetting, from the surfaces that frames share.

The logarithms of one gain per frame and channel, and of the brightness lost towards the corners, a polynomial of the radius that all frames
have in common, are one robust least squares fit: in each voxel, the frames that see it should agree on its colour. The voxels' own colours
are eliminated. After M. Brown, D. Lowe, IJCV 2007, section 6, doi:10.1007/s11263-006-0002-3, with a voxel in place of an overlap; and
D. Goldman, PAMI 2010, doi:10.1109/TPAMI.2010.55, for vignetting.
"""

from collections.abc import Iterable
from dataclasses import dataclass

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
POWERS = (2, 4, 6)  # of the radius, 1 at an image's corners


@dataclass(frozen=True)
class Evening:
    """What makes frames agree on colours, as logarithms of factors."""

    gain: np.ndarray  # (K, 3) of each frame's channels
    falloff: np.ndarray  # (3, 3) of each channel by POWERS of the radius

    def shading(self, height: int, width: int) -> np.ndarray:
        """Return the factors (H, W, 3) float32 that take vignetting off an image, gains left aside."""
        radial = _radial(np.arange(height * width), height, width)
        log_factor = sum(radial[:, k, None] * self.falloff[:, k] for k in range(len(POWERS)))
        return elementary.exp(log_factor).astype(np.float32).reshape(height, width, -1)


def fit_evening(frames: Iterable[tuple[Surface, np.ndarray, np.ndarray]]) -> Evening:
    """Find the factors by which frames' channels are to be multiplied so that they agree.

    frames : per frame what it saw, its colours (H, W, 3) uint8, and its pose (4, 4), camera to world
    """
    key, log_colour, radial = _samples(frames)
    n_frames = len(key)
    counts = np.array([len(k) for k in key])
    if n_frames == 0 or counts.sum() == 0:
        return Evening(np.zeros((n_frames, 3)), np.zeros((3, len(POWERS))))
    of_frame = np.repeat(np.arange(n_frames), counts)
    of_voxel = np.unique(np.concatenate(key), return_inverse=True)[1]
    return fit_logarithms(of_frame, of_voxel, np.concatenate(log_colour), np.concatenate(radial), n_frames=n_frames)


def _radial(pixel: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the POWERS (N, 3) of the distances of pixels (N,) from an image's centre."""
    v, u = pixel // width - 0.5 * (height - 1), pixel % width - 0.5 * (width - 1)
    square = (u * u + v * v) / max(0.25 * ((height - 1) ** 2 + (width - 1) ** 2), 1.0)
    return np.stack([square, square * square, square * square * square], axis=-1)


def _samples(frames: Iterable[tuple[Surface, np.ndarray, np.ndarray]]) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Collect each frame's voxels, each once, with the mean logarithm of its colours there and the mean powers of the radius."""
    key, log_colour, radial = [], [], []
    for seen, rgb, T_wc in frames:
        every = max(1, len(seen.pixel) // (4 * MOST_SAMPLES))
        pixel = seen.pixel[::every]
        colour = rgb.reshape(-1, 3)[pixel]
        is_told = (colour.min(axis=1, initial=255) >= DARKEST) & (colour.max(axis=1, initial=0) <= BRIGHTEST)
        xyz = se3.transform(T_wc, seen.xyz_c[::every][is_told].astype(np.float64))
        cell = np.floor(xyz / SIDE).astype(np.int64) + HALF_EXTENT
        inside = ((cell >= 0) & (cell < 2 * HALF_EXTENT)).all(axis=1)
        cells, row = np.unique(voxel.morton(cell[inside]), return_inverse=True)
        logs = elementary.log(colour[is_told][inside].astype(np.float64))
        values = np.column_stack([logs, _radial(pixel[is_told][inside].astype(np.int64), *rgb.shape[:2])])
        total = np.column_stack([np.bincount(row, weights=column, minlength=len(cells)) for column in values.T])
        mean = (total / np.maximum(np.bincount(row, minlength=len(cells)), 1)[:, None]).astype(np.float32)
        step = max(1, -(-len(cells) // MOST_SAMPLES))
        # Whole families of voxels are taken, not every so many rows: other frames must take the same ones.
        kept = (cells * 2654435761 >> 16) % step == 0
        key.append(cells[kept])
        log_colour.append(mean[kept, :3])
        radial.append(mean[kept, 3:])
    return key, log_colour, radial


def fit_logarithms(of_frame: np.ndarray, of_voxel: np.ndarray, log_colour: np.ndarray, radial: np.ndarray, *, n_frames: int) -> Evening:
    """Fit gains and falloff to samples (N,) of frames in voxels with the logarithms (N, 3) of their colours and powers (N, 3) of the radius.

    Minimizes sum w (log_colour + gain + falloff . radial - colour of the voxel)^2, Tukey's weights, plus a weak prior that keeps frames
    without overlap as they are. Gains and falloff together leave the samples' mean brightness as it is.
    """
    n_channels, n_powers = log_colour.shape[1], radial.shape[1]
    gain, falloff = np.zeros((n_frames, n_channels)), np.zeros((n_channels, n_powers))
    radial = radial.astype(np.float64)
    for channel in range(n_channels):
        value = log_colour[:, channel].astype(np.float64)
        weight = np.full(len(value), 1.0 / NOISE**2)
        for _ in range(ROUNDS):
            found = _solved(of_frame, of_voxel, value, radial, weight, n_frames)
            gain[:, channel], falloff[channel] = found[:n_frames], found[n_frames:]
            evened = value + gain[of_frame, channel] + (radial * falloff[channel]).sum(axis=1)
            residual = np.abs(_centred(evened[:, None], of_voxel, weight)[:, 0])
            scale = TUKEY * max(MAD * float(np.median(residual)), LEAST_DEVIATION)
            weight = np.square(np.maximum(1.0 - np.square(residual / scale), LEAST_WEIGHT)) / NOISE**2
        gain[:, channel] -= gain[:, channel].mean() + (radial * falloff[channel]).sum(axis=1).mean()
    return Evening(gain, falloff)


def _solved(
    of_frame: np.ndarray, of_voxel: np.ndarray, value: np.ndarray, radial: np.ndarray, weight: np.ndarray, n_frames: int
) -> np.ndarray:
    """Solve the normal equations of one channel, the voxels' colours eliminated, for the gains and then the falloff."""
    n_voxels = int(of_voxel.max(initial=-1)) + 1
    M = sparse.csr_matrix((weight, (of_frame, of_voxel)), shape=(n_frames, n_voxels))
    per_voxel = np.maximum(np.asarray(M.sum(axis=0)).ravel(), 1e-12)
    weighted = weight[:, None] * _centred(np.column_stack([radial, value]), of_voxel, weight)
    of_frames = np.column_stack([np.bincount(of_frame, weights=column, minlength=n_frames) for column in weighted.T])
    n = n_frames + radial.shape[1]
    A = np.empty((n, n))
    A[:n_frames, :n_frames] = -(M @ sparse.diags(1.0 / per_voxel) @ M.T).toarray()
    A[np.arange(n_frames), np.arange(n_frames)] += np.asarray(M.sum(axis=1)).ravel()
    A[:n_frames, n_frames:], A[n_frames:, :n_frames] = of_frames[:, :-1], of_frames[:, :-1].T
    A[n_frames:, n_frames:] = (radial[:, :, None] * weighted[:, None, :-1]).sum(axis=0)
    A[np.arange(n), np.arange(n)] += PRIOR**2
    return solve(A, -np.append(of_frames[:, -1], (radial * weighted[:, -1:]).sum(axis=0)))


def _centred(columns: np.ndarray, of_voxel: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Subtract from columns (N, C) their weighted means over the samples of the same voxel."""
    total = np.maximum(np.bincount(of_voxel, weights=weight), 1e-12)
    mean = np.column_stack([np.bincount(of_voxel, weights=weight * column) / total for column in columns.T])
    return columns - mean[of_voxel]


def evened(rgb: np.ndarray, log_gain: np.ndarray, shading: np.ndarray) -> np.ndarray:
    """Multiply an image (H, W, 3) uint8 by the gains of its channels, logarithms (3,), and by `shading` (H, W, 3)."""
    return np.clip(np.rint(rgb * (shading * elementary.exp(log_gain).astype(np.float32))), 0, 255).astype(np.uint8)
