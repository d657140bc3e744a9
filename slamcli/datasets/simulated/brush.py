"""What procedural textures are painted with: noise, rectangles, discs, text, all given in metres.

A painter is ``painter(rng, width, height, scale) -> (h, w, 3) uint8``: the picture of a surface of width x height metres at `scale`
pixels per metre, row 0 at the top. While being painted a picture is float32.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from slamcli.jit.kernel import kernel

Painter = Callable[[np.random.Generator, float, float, float], np.ndarray]
Colour = tuple[float, float, float]

INK = (38, 38, 46)
PAPER = (242, 238, 228)
PALETTES: tuple[tuple[Colour, ...], ...] = (
    ((231, 111, 81), (244, 162, 97), (233, 196, 106), (42, 157, 143), (38, 70, 83)),
    ((2, 48, 71), (33, 158, 188), (142, 202, 230), (255, 183, 3), (251, 133, 0)),
    ((96, 108, 56), (40, 54, 24), (254, 250, 224), (221, 161, 94), (188, 108, 37)),
    ((230, 57, 70), (241, 250, 238), (168, 218, 220), (69, 123, 157), (29, 53, 87)),
    ((94, 84, 142), (159, 134, 192), (190, 149, 196), (224, 177, 203), (35, 25, 66)),
)
WORDS = "north river stone paper lemon cloud sample robot garden orbit signal harbour copper velvet maple echo delta quartz"
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)


def vector(colour: Colour) -> np.ndarray:
    """Return a colour as (3,) float32."""
    return np.array(colour, dtype=np.float32)


def canvas(width: float, height: float, scale: float, colour: Colour) -> np.ndarray:
    """Return a picture of one colour, float32 while it is being painted."""
    shape = max(2, round(height * scale)), max(2, round(width * scale))
    return np.broadcast_to(vector(colour), (*shape, 3)).copy()


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[float, float]) -> np.ndarray:
    """Return noise in about -1..1 that varies over `cells` (rows, columns) [px]."""
    grid = [max(2, int(np.ceil(n / max(cell, 1.0))) + 1) for n, cell in zip(shape, cells, strict=True)]
    coarse = rng.uniform(-1.0, 1.0, grid).astype(np.float32)
    return cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)


def cloudy(rng: np.random.Generator, shape: tuple[int, int], cell: float, octaves: int = 4) -> np.ndarray:
    """Return fractal noise in about -1..1 whose largest blots measure `cell` px."""
    layers = [0.5**k * smooth_noise(rng, shape, (cell * 0.5**k, cell * 0.5**k)) for k in range(octaves)]
    return np.array(layers).sum(axis=0) / np.float32(1.6)


def finish(image: np.ndarray) -> np.ndarray:
    """Turn a finished picture into uint8."""
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def pick(rng: np.random.Generator, options: tuple) -> Any:
    """Draw one of several."""
    return options[int(rng.integers(len(options)))]


def tint(colour: Colour, factor: float = 1.0, shift: float = 0.0, spread: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Colour:
    """Return a colour made darker or lighter, kept within 0..255."""
    r, g, b = (min(255.0, max(0.0, factor * c + shift + d)) for c, d in zip(colour, spread, strict=True))
    return r, g, b


def rectangle(image: np.ndarray, scale: float, x: float, y: float, w: float, h: float, colour: Colour) -> None:
    """Fill a rectangle given in metres, its edges antialiased; what falls outside is cut off."""
    _fill(image, x * scale, y * scale, (x + w) * scale, (y + h) * scale, *map(float, colour))


@kernel
def _fill(image, left, top, right, bottom, red, green, blue):
    left, right = max(left, 0.0), min(right, float(image.shape[1]))
    top, bottom = max(top, 0.0), min(bottom, float(image.shape[0]))
    for row in range(int(top), int(np.ceil(bottom))):
        cover_y = min(row + 1.0, bottom) - max(float(row), top)
        for column in range(int(left), int(np.ceil(right))):
            cover = np.float32(cover_y * (min(column + 1.0, right) - max(float(column), left)))
            image[row, column, 0] += cover * (np.float32(red) - image[row, column, 0])
            image[row, column, 1] += cover * (np.float32(green) - image[row, column, 1])
            image[row, column, 2] += cover * (np.float32(blue) - image[row, column, 2])


def disc(image: np.ndarray, scale: float, x: float, y: float, radius: float, colour: Colour, thickness: float = 0.0) -> None:
    """Draw a disc, or a ring of some thickness, given in metres."""
    centre = (round(x * scale * 16), round(y * scale * 16))
    width = max(1, round(thickness * scale)) if thickness else -1
    cv2.circle(image, centre, round(radius * scale * 16), colour, width, cv2.LINE_AA, 4)


def write(image: np.ndarray, scale: float, x: float, y: float, height: float, text: str, colour: Colour, font: int = FONTS[1]) -> None:
    """Write text, its baseline starting at (x, y), capital letters `height` high, in metres."""
    size = height * scale / 21.0  # Hershey capitals are 21 units high
    if size < 0.12:
        return
    thickness = max(1, round(1.6 * size))
    (w, h), below = cv2.getTextSize(text, font, size, thickness)
    mask = np.zeros((h + 2 * below + 4, w + 4), dtype=np.uint8)  # text can be drawn on 8 bits only
    cv2.putText(mask, text, (2, h + below), font, size, 255, thickness, cv2.LINE_AA)
    row, column = round(y * scale) - h - below, round(x * scale) - 2
    target = image[max(row, 0) : max(row + mask.shape[0], 0), max(column, 0) : max(column + mask.shape[1], 0)]
    alpha = mask[max(-row, 0) :, max(-column, 0) :][: target.shape[0], : target.shape[1], None].astype(np.float32) / 255.0
    target += alpha * (vector(colour) - target)


def paste(image: np.ndarray, scale: float, x: float, y: float, picture: np.ndarray) -> None:
    """Put a picture with its upper left corner at (x, y) [m]; what falls outside is cut off."""
    row, column = round(y * scale), round(x * scale)
    target = image[max(row, 0) : row + picture.shape[0], max(column, 0) : column + picture.shape[1]]
    target[:] = picture[max(-row, 0) : max(-row, 0) + target.shape[0], max(-column, 0) : max(-column, 0) + target.shape[1]]


def shadow(image: np.ndarray, scale: float, x: float, y: float, w: float, h: float) -> None:
    """Darken softly below and beside something that stands out from a wall."""
    for grow, dark in ((0.03, 0.94), (0.015, 0.9)):
        rows = slice(max(0, round((y - grow / 2) * scale)), max(0, round((y + h + 1.5 * grow) * scale)))
        columns = slice(max(0, round((x - grow / 2) * scale)), max(0, round((x + w + grow) * scale)))
        image[rows, columns] *= dark
