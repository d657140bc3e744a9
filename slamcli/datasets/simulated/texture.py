"""Materials of the simulated room: paint, bricks, wood, tiles, cloth, leaves.

Detail comes at several scales, from centimetres to half a metre, so that corners are found near and far.
"""

import cv2
import numpy as np

from slamcli.datasets.simulated.brush import Colour, Painter, canvas, cloudy, disc, finish, pick, rectangle, smooth_noise, tint, vector


def flat(colour: Colour) -> Painter:
    """Nothing but a colour."""
    return lambda rng, width, height, scale: finish(canvas(width, height, min(scale, 2.0 / min(width, height)), colour))


def plaster(colour: Colour, roughness: float = 5.0) -> Painter:
    """Painted wall: faint clouds and a fine grain."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, colour)
        image += (roughness * (cloudy(rng, image.shape[:2], 0.4 * scale) + 0.8 * smooth_noise(rng, image.shape[:2], (0.012 * scale,) * 2)))[
            ..., None
        ]
        return finish(image)

    return paint


def wood(colour: Colour, contrast: float = 20.0, along_x: bool = True) -> Painter:
    """Wood grain with some knots."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, colour)
        shape = image.shape[:2] if along_x else image.shape[1::-1]
        grain = smooth_noise(rng, shape, (0.03 * scale, 0.8 * scale)) + 0.7 * smooth_noise(rng, shape, (0.008 * scale, 0.25 * scale))
        image += (contrast * 0.6 * (grain if along_x else grain.T))[..., None] * vector((1.0, 0.9, 0.7))
        for _ in range(rng.poisson(5.0 * width * height)):
            x, y = rng.uniform(0, width), rng.uniform(0, height)
            dark = tint(colour, 0.55)
            disc(image, scale, x, y, rng.uniform(0.005, 0.012), dark)
        return finish(image)

    return paint


def brick(colour: Colour) -> Painter:
    """Brickwork, each brick a little different."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, (196, 188, 176))
        brick_h, brick_w, joint = 0.075, 0.24, 0.012
        for row in range(int(height / brick_h) + 1):
            for column in range(-1, int(width / brick_w) + 1):
                spread = tuple(rng.normal(0.0, 7.0, 3))
                x = (column + 0.5 * (row % 2)) * brick_w
                shade = tint(colour, shift=rng.normal(0.0, 17.0), spread=spread)
                rectangle(image, scale, x, row * brick_h, brick_w - joint, brick_h - joint, shade)
        image += (9.0 * cloudy(rng, image.shape[:2], 0.05 * scale, 3))[..., None]
        return finish(image)

    return paint


def stripes(colours: tuple[Colour, ...], pitch: float) -> Painter:
    """Wallpaper of uneven upright stripes with a small motif at uneven places."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, colours[0])
        x = 0.0
        while x < width:
            step = pitch * rng.uniform(0.5, 1.5)
            rectangle(image, scale, x, 0.0, step * 0.55, height, colours[1])
            x += step
        for _ in range(int(10 * width * height)):
            x, y, size = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.008, 0.025)
            disc(image, scale, x, y, size, colours[2])
            disc(image, scale, x + 1.2 * size, y - 1.2 * size, 0.6 * size, colours[2])
        image += (3.0 * cloudy(rng, image.shape[:2], 0.2 * scale))[..., None]
        return finish(image)

    return paint


def planks(colour: Colour) -> Painter:
    """Wooden floor: staggered boards of different tone, grain and dark joints."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, colour)
        board, y = 0.11, 0.0
        joint = tint(colour, 0.45)
        while y < height:
            x = -rng.uniform(0.0, 1.0)
            while x < width:
                length = rng.uniform(0.45, 1.2)
                tone = tint(colour, rng.uniform(0.72, 1.2), spread=tuple(rng.normal(0.0, 4.0, 3)))
                rectangle(image, scale, x, y, length, board, tone)
                rectangle(image, scale, x, y, 0.004, board, joint)
                for _ in range(rng.poisson(0.9)):
                    disc(image, scale, x + rng.uniform(0, length), y + rng.uniform(0.1, 0.9) * board, rng.uniform(0.004, 0.011), joint)
                x += length
            rectangle(image, scale, 0.0, y, width, 0.004, joint)
            y += board
        shape = image.shape[:2]
        grain = smooth_noise(rng, shape, (0.02 * scale, 0.4 * scale)) + 0.8 * smooth_noise(rng, shape, (0.007 * scale, 0.12 * scale))
        image += (9.0 * grain)[..., None] * vector((1.0, 0.9, 0.7))
        return finish(image)

    return paint


def tiles(colour: Colour, side: float = 0.3) -> Painter:
    """Stone tiles with speckles."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, tint(colour, 0.55))
        for row in range(int(height / side) + 1):
            for column in range(int(width / side) + 1):
                tone = tint(colour, shift=rng.normal(0.0, 9.0), spread=tuple(rng.normal(0.0, 3.0, 3)))
                rectangle(image, scale, column * side, row * side, side - 0.006, side - 0.006, tone)
        image += (10.0 * cloudy(rng, image.shape[:2], 0.12 * scale))[..., None]
        for _ in range(int(110 * width * height)):
            tone = tint(colour, pick(rng, (0.5, 0.7, 1.2)))
            disc(image, scale, rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.003, 0.009), tone)
        return finish(image)

    return paint


def fabric(colour: Colour, accent: Colour) -> Painter:
    """Upholstery: weave, seams and a scattered pattern."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, colour)
        for _ in range(int(60 * width * height) + 2):
            x, y, size = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.006, 0.022)
            tone = tint(accent, rng.uniform(0.7, 1.1))
            rectangle(image, scale, x, y, size * rng.uniform(0.5, 2), size, tone)
        image += (9.0 * smooth_noise(rng, image.shape[:2], (0.008 * scale, 0.008 * scale)))[..., None]
        return finish(image)

    return paint


def foliage(colour: Colour) -> Painter:
    """Leaves upon leaves."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, tint(colour, 0.4))
        for _ in range(int(700 * width * height)):
            centre = (round(rng.uniform(0, width) * scale), round(rng.uniform(0, height) * scale))
            axes = (max(1, round(rng.uniform(0.02, 0.045) * scale)), max(1, round(rng.uniform(0.009, 0.02) * scale)))
            tone = tint(colour, rng.uniform(0.5, 1.25))
            cv2.ellipse(image, centre, axes, rng.uniform(0, 180), 0, 360, tone, -1, cv2.LINE_AA)
        return finish(image)

    return paint


def repeated(painter: Painter, pitch: float) -> Painter:
    """Repeat one and the same picture of width `pitch` [m] along x: what aliasing rooms are made of."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        scale = max(1, round(pitch * scale)) / pitch  # a whole number of pixels a period, or the copies would differ
        tile = painter(rng, pitch, height, scale)
        columns = np.arange(round(width * scale)) % tile.shape[1]
        return np.ascontiguousarray(tile[:, columns])

    return paint


def untextured(painter: Painter) -> Painter:
    """Keep only a surface's mean colour."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        mean = painter(rng, width, height, 40.0).reshape(-1, 3).mean(axis=0)
        return flat(tuple(mean.tolist()))(rng, width, height, scale)

    return paint
