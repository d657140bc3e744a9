"""Orientation by intensity centroid and rotated BRIEF.

E. Rublee, V. Rabaud, K. Konolige, G. Bradski, ORB: an efficient alternative to SIFT or SURF, ICCV 2011, doi:10.1109/ICCV.2011.6126544
"""

import numpy as np
from numba import f4, f8, i4, i8, int16, int32, u1, u4, uint32, uintp

from slamcli.geometry import elementary
from slamcli.jit.kernel import kernel
from slamcli.vision.pattern import PAIRS

PATCH_RADIUS = 15  # [px] of the disc whose centroid gives the orientation
BORDER = 19  # [px] the farthest a rotated test point reaches, ceil(13 sqrt 2)

ROUND = np.float32(1.5 * 2**23)  # adding it leaves a float32 no digits after the point: x + ROUND - ROUND is x rounded, halves to even

_PAIR_X, _PAIR_Y = (PAIRS[:, :, axis].T.ravel().astype(np.float32) for axis in (0, 1))


def _disc() -> np.ndarray:
    """Return the half width of each row 0..15 of the disc, made symmetric about the diagonal as in OpenCV."""
    half = np.zeros(PATCH_RADIUS + 1, dtype=np.int32)
    middle = int(np.floor(PATCH_RADIUS * np.sqrt(0.5) + 1))
    for v in range(middle + 1):
        half[v] = round(np.sqrt(PATCH_RADIUS**2 - v**2))
    row = 0
    for v in range(PATCH_RADIUS, int(np.ceil(PATCH_RADIUS * np.sqrt(0.5))) - 1, -1):
        while half[row] == half[row + 1]:
            row += 1
        half[v] = row
        row += 1
    return half


def _disc_mask() -> np.ndarray:
    """Return the disc as 255 within 31 rows of 32 pixels: a row is one vector register, so that no row needs a length of its own."""
    mask = np.zeros((2 * PATCH_RADIUS + 1, 2 * PATCH_RADIUS + 2), dtype=np.uint8)
    for row, half in enumerate(_disc()[abs(v)] for v in range(-PATCH_RADIUS, PATCH_RADIUS + 1)):
        mask[row, PATCH_RADIUS - half : PATCH_RADIUS + half + 1] = 255
    return mask


_MASK = _disc_mask()


@kernel
def _orient(image: u1[:, ::1], xy: i4[:, ::1], mask: u1[:, ::1], angle: f4[::1]):
    """Write each point's orientation [rad, -pi to pi]: the direction from the point to the centroid of the disc around it.

    image : (H, W) uint8; xy : (N, 2) int32, more than PATCH_RADIUS px inside; mask : the disc; angle : (N,) float32
    """
    width = image.shape[1]
    flat = image.ravel()
    # 16 bits hold a column's sum (31 * 255) and its first moment (at most 15 * 16 / 2 * 255 either way).
    total, moment = np.empty(32, dtype=np.int16), np.empty(32, dtype=np.int16)
    for k in range(len(xy)):
        total[:] = 0
        moment[:] = 0
        place = uintp((xy[k, 1] - PATCH_RADIUS) * width + xy[k, 0] - PATCH_RADIUS)
        for v in range(2 * PATCH_RADIUS + 1):
            height = int16(v - PATCH_RADIUS)
            inside = mask[v]
            for u in range(32):
                grey = int16(flat[place + uintp(u)] & inside[u])
                total[u] = int16(total[u] + grey)
                moment[u] = int16(moment[u] + int16(height * grey))
            place += uintp(width)
        m01, m10 = 0, 0
        for u in range(32):
            m10 += (u - PATCH_RADIUS) * int32(total[u])
            m01 += int32(moment[u])
        angle[k] = elementary.arctangent2(float(m01), float(m10))


@kernel
def _describe(
    smooth: u1[::1], width: i8, xy: i4[:, ::1], angle: f4[::1], pair_x: f4[::1], pair_y: f4[::1], place: u4[::1], desc: u1[:, ::1]
):
    """Write the 256 comparisons of each point's turned test pattern as bits, lowest bit first.

    smooth : (H W,) uint8, blurred; xy : (N, 2) int32, at least BORDER px inside
    pair_x, pair_y : (512,) float32, the first points of the pairs, then the second; place : (512,) uint32, scratch; desc : (N, 32) uint8
    """
    row = np.float32(width)  # float32 is exact up to 2^24
    corner = np.float32(BORDER * width + BORDER)  # keeps places positive: negative ones would be tested for and wrapped
    for k in range(len(xy)):
        cos, sin = np.float32(elementary.cosine(f8(angle[k]))), np.float32(elementary.sine(f8(angle[k])))
        for p in range(512):
            x, y = pair_x[p], pair_y[p]
            place[p] = uint32(((x * sin + y * cos + ROUND) - ROUND) * row + ((x * cos - y * sin + ROUND) - ROUND) + corner)
        start = uintp((xy[k, 1] - BORDER) * width + xy[k, 0] - BORDER)
        for byte in range(32):
            value = 0
            for bit in range(8):
                p = 8 * byte + bit
                value |= (smooth[start + place[p]] < smooth[start + place[p + 256]]) << bit
            desc[k, byte] = value


def orientation(image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return the orientation (N,) float32 [rad] of points xy (N, 2) int32 of a grey image."""
    angle = np.empty(len(xy), dtype=np.float32)
    _orient(image, xy, _MASK, angle)
    return angle


def descriptors(smooth: np.ndarray, xy: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the descriptors (N, 32) uint8 of points xy (N, 2) int32 with orientation angle (N,) [rad] of a blurred image."""
    desc = np.empty((len(xy), 32), dtype=np.uint8)
    _describe(smooth.ravel(), smooth.shape[1], xy, angle, _PAIR_X, _PAIR_Y, np.empty(512, dtype=np.uint32), desc)
    return desc
