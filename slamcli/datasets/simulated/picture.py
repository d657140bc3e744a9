"""What hangs on the walls of the simulated room, fronts of its furniture, and whole walls, floors and ceilings."""

import cv2
import numpy as np

from slamcli.datasets.simulated.brush import (
    FONTS,
    INK,
    PALETTES,
    PAPER,
    WORDS,
    Colour,
    Painter,
    canvas,
    cloudy,
    disc,
    finish,
    paste,
    pick,
    rectangle,
    shadow,
    smooth_noise,
    tint,
    vector,
    write,
)  # fmt: skip
from slamcli.datasets.simulated.texture import fabric, wood


def shapes(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Abstract picture of overlapping discs, bars and triangles."""
    palette = pick(rng, PALETTES)
    image = canvas(width, height, scale, pick(rng, (*palette, PAPER)))
    for _ in range(int(rng.integers(14, 26))):
        x, y, size = rng.uniform(0, width), rng.uniform(0, height), min(width, height) * rng.uniform(0.04, 0.25)
        colour, kind = pick(rng, palette), rng.integers(4)
        if kind == 0:
            disc(image, scale, x, y, size, colour)
        elif kind == 1:
            disc(image, scale, x, y, size, colour, thickness=0.2 * size)
        elif kind == 2:
            rectangle(image, scale, x - size, y - 0.4 * size, 2 * size, 0.8 * size, colour)
        else:
            corners = np.array([x, y]) + size * rng.uniform(-1.3, 1.3, (3, 2))
            cv2.fillConvexPoly(image, (corners * scale * 16).astype(np.int32), colour, cv2.LINE_AA, 4)
    return finish(image)


def landscape(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Hills one behind the other under a sky."""
    palette = pick(rng, PALETTES)
    image = canvas(width, height, scale, palette[2])
    rows, columns = image.shape[:2]
    sky = np.linspace(0.0, 1.0, rows, dtype=np.float32)[:, None, None]
    image[:] = (1 - sky) * vector(palette[1]) + sky * vector((250, 236, 210))
    disc(image, scale, rng.uniform(0.2, 0.8) * width, rng.uniform(0.15, 0.35) * height, 0.09 * min(width, height), (255, 240, 190))
    for k in range(5):
        crest = (0.35 + 0.13 * k) * rows + 0.10 * rows * cloudy(rng, (2, columns), columns / (2 + k), 5)[0]
        tone = vector(tint(palette[k % 5], 1.0 - 0.1 * k))
        cover = np.clip(np.arange(rows, dtype=np.float32)[:, None] - crest[None, :], 0, 1)[..., None]
        image += cover * (tone - image)
    image += (6.0 * cloudy(rng, (rows, columns), 0.03 * scale, 3))[..., None]
    return finish(image)


def notice(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Poster with a headline, a picture and lines of text."""
    palette = pick(rng, PALETTES)
    image = canvas(width, height, scale, pick(rng, (PAPER, (250, 250, 250), palette[2])))
    rectangle(image, scale, 0, 0, width, 0.2 * height, palette[0])
    words = tuple(WORDS.split())
    write(image, scale, 0.06 * width, 0.15 * height, 0.09 * height, pick(rng, words).upper(), PAPER, pick(rng, FONTS))
    paste(image, scale, 0.1 * width, 0.25 * height, shapes(rng, 0.8 * width, 0.33 * height, scale))
    y = 0.66 * height
    while y < 0.95 * height:
        line = " ".join(pick(rng, words) for _ in range(6))
        write(image, scale, 0.08 * width, y, 0.03 * height, line[: int(rng.integers(16, 30))], INK, FONTS[0])
        y += 0.055 * height
    return finish(image)


def mosaic(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Coloured squares of two sizes."""
    palette = pick(rng, PALETTES)
    image = canvas(width, height, scale, palette[4])
    side = min(width, height) / rng.integers(5, 9)
    for row in range(int(height / side) + 1):
        for column in range(int(width / side) + 1):
            rectangle(image, scale, column * side, row * side, 0.92 * side, 0.92 * side, pick(rng, palette))
            if rng.random() < 0.5:
                a, b = rng.uniform(0.1, 0.5, 2) * side
                rectangle(image, scale, column * side + a, row * side + b, 0.4 * side, 0.4 * side, pick(rng, (*palette, PAPER)))
    return finish(image)


PICTURES: tuple[Painter, ...] = (shapes, landscape, notice, mosaic)


def window(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Window with houses outside."""
    image = canvas(width, height, scale, (188, 216, 240))
    x = 0.0
    while x < width:
        w, h = rng.uniform(0.15, 0.4), rng.uniform(0.25, 0.7) * height
        tone = pick(rng, ((205, 150, 120), (220, 205, 170), (170, 175, 185), (190, 120, 100)))
        rectangle(image, scale, x, height - h, w, h, tone)
        for wx in np.arange(x + 0.025, x + w - 0.03, 0.06):
            for wy in np.arange(height - h + 0.03, height, 0.08):
                rectangle(image, scale, wx, wy, 0.03, 0.045, pick(rng, ((70, 85, 105), (95, 110, 130), (240, 220, 160))))
        x += w
    for share in (0.0, 0.5, 1.0):
        rectangle(image, scale, share * width - 0.03, 0, 0.06, height, (245, 245, 242))
        rectangle(image, scale, 0, share * height - 0.03, width, 0.06, (245, 245, 242))
    return finish(image)


def door(colour: Colour, label: str = "") -> Painter:
    """Panelled door with handle and number."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = wood(colour, 10.0, along_x=False)(rng, width, height, scale).astype(np.float32)
        dark, light = tint(colour, 0.7), tint(colour, 1.12)
        for y, h in ((0.1, 0.3), (0.47, 0.22), (0.75, 0.18)):
            for x in (0.12, 0.55):
                rectangle(image, scale, x * width, y * height, 0.33 * width, h * height, dark)
                rectangle(image, scale, x * width + 0.015, y * height + 0.015, 0.33 * width - 0.015, h * height - 0.015, light)
        disc(image, scale, 0.9 * width, 0.52 * height, 0.03, (200, 190, 120))
        rectangle(image, scale, 0.35 * width, 0.03 * height, 0.3 * width, 0.055 * height, PAPER)
        write(image, scale, 0.38 * width, 0.075 * height, 0.065, label or str(rng.integers(100, 999)), INK)
        return finish(image)

    return paint


def books(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Row of book spines."""
    image = canvas(width, height, scale, (30, 26, 24))
    x = 0.0
    while x < width:
        w, top = rng.uniform(0.018, 0.05), rng.uniform(0.0, 0.3) * height
        tone = tint(pick(rng, pick(rng, PALETTES)), rng.uniform(0.6, 1.05))
        rectangle(image, scale, x, top, w - 0.002, height, tone)
        band = pick(rng, (PAPER, INK, (212, 175, 55)))
        for _ in range(int(rng.integers(1, 4))):
            rectangle(image, scale, x, top + rng.uniform(0.1, 0.8) * (height - top), w - 0.002, rng.uniform(0.004, 0.03), band)
        x += w
    return finish(image)


def drawers(colour: Colour, rows: int, columns: int) -> Painter:
    """Front with drawers or doors, their joints and knobs."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = wood(colour, 16.0)(rng, width, height, scale).astype(np.float32)
        dark = tint(colour, 0.4)
        w, h = width / columns, height / rows
        for row in range(rows):
            for column in range(columns):
                x, y = column * w, row * h
                for edge in ((x, y, w, 0.008), (x, y, 0.008, h), (x, y + h - 0.008, w, 0.008), (x + w - 0.008, y, 0.008, h)):
                    rectangle(image, scale, *edge, dark)
                disc(image, scale, x + 0.5 * w, y + 0.3 * h, 0.016, (225, 215, 190))
                disc(image, scale, x + 0.5 * w, y + 0.3 * h, 0.008, dark)
        for _ in range(rng.poisson(2.0)):  # stickers
            side = rng.uniform(0.05, 0.12)
            paste(
                image,
                scale,
                rng.uniform(0, max(0.01, width - side)),
                rng.uniform(0, max(0.01, height - side)),
                mosaic(rng, side, side, scale),
            )
        return finish(image)

    return paint


def desk(colour: Colour) -> Painter:
    """Table top with sheets of paper on it."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = wood(colour, 22.0)(rng, width, height, scale).astype(np.float32)
        for _ in range(int(5 * width * height) + 1):
            w, h = (0.21, 0.297) if rng.random() < 0.5 else (0.297, 0.21)
            if w < width and h < height:
                sheet = pick(rng, (notice, notice, mosaic, shapes))(rng, w, h, scale)
                paste(image, scale, rng.uniform(0, width - w), rng.uniform(0, height - h), sheet)
        return finish(image)

    return paint


def cardboard(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Side of a parcel: tape, a label and print."""
    image = canvas(width, height, scale, (184, 140, 92))
    image += (7.0 * smooth_noise(rng, image.shape[:2], (0.2 * scale, 0.006 * scale)))[..., None]
    rectangle(image, scale, 0, 0.42 * height, width, 0.16 * height, (214, 186, 140))
    label = notice(rng, 0.42 * width, 0.36 * height, scale)
    paste(image, scale, rng.uniform(0.03, 0.5) * width, rng.uniform(0.03, 0.1) * height, label)
    write(image, scale, 0.08 * width, 0.85 * height, 0.2 * height, pick(rng, tuple(WORDS.split())).upper(), INK, FONTS[3])
    for k in range(3):
        rectangle(image, scale, (0.72 + 0.08 * k) * width, 0.66 * height, 0.05 * width, 0.25 * height, (150, 40, 40))
    return finish(image)


def screen(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
    """Monitor that shows a picture."""
    image = canvas(width, height, scale, (28, 28, 32))
    paste(image, scale, 0.025, 0.025, pick(rng, PICTURES)(rng, width - 0.05, height - 0.05, scale))
    return finish(image)


def wall(base: Painter, items: tuple[tuple[float, float, float, float, Painter], ...]) -> Painter:
    """Wall with framed things on it: (x, y of the upper left corner, width, height, painter), metres from the wall's upper left corner."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = base(rng, width, height, scale).astype(np.float32)
        rectangle(image, scale, 0.0, height - 0.08, width, 0.08, (235, 232, 225))
        rectangle(image, scale, 0.0, height - 0.085, width, 0.008, (120, 115, 108))
        for x, y, w, h, painter in items:
            shadow(image, scale, x, y, w, h)
            frame = pick(rng, (INK, (120, 85, 55), (236, 234, 228), (60, 60, 70)))
            rectangle(image, scale, x, y, w, h, frame)
            paste(image, scale, x + 0.02, y + 0.02, painter(rng, w - 0.04, h - 0.04, scale))
        return finish(image)

    return paint


def floor(base: Painter, rugs: tuple[tuple[float, float, float, float], ...]) -> Painter:
    """Floor with rugs (x, y, width, height)."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = base(rng, width, height, scale).astype(np.float32)
        for x, y, w, h in rugs:
            palette = pick(rng, PALETTES)
            rectangle(image, scale, x, y, w, h, palette[4])
            rectangle(image, scale, x + 0.05, y + 0.05, w - 0.1, h - 0.1, palette[1])
            paste(image, scale, x + 0.12, y + 0.12, fabric(palette[0], palette[2])(rng, w - 0.24, h - 0.24, scale))
        return finish(image)

    return paint


def ceiling(lamps: tuple[tuple[float, float], ...]) -> Painter:
    """Acoustic tiles with holes, and lamps whose centres are given [m]."""

    def paint(rng: np.random.Generator, width: float, height: float, scale: float) -> np.ndarray:
        image = canvas(width, height, scale, (226, 224, 218))
        for x in np.arange(0.0, width, 0.6):
            rectangle(image, scale, x, 0, 0.015, height, (170, 168, 162))
        for y in np.arange(0.0, height, 0.6):
            rectangle(image, scale, 0, y, width, 0.015, (170, 168, 162))
        for _ in range(int(60 * width * height)):
            disc(image, scale, rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.004, 0.012), (150, 148, 142))
        for x, y in lamps:
            rectangle(image, scale, x - 0.32, y - 0.32, 0.64, 0.64, (140, 140, 140))
            rectangle(image, scale, x - 0.3, y - 0.3, 0.6, 0.6, (255, 253, 244))
        return finish(image)

    return paint
