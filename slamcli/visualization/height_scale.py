"""What the colours of heights mean: a bar with numbers, drawn into the corner of a picture."""

import cv2
import numpy as np

BAR = 18  # px, width of the bar in a picture 1000 px high
INK = (29, 35, 41)
STEPS = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0])  # [m] between numbers


def add(image: np.ndarray, colours: np.ndarray, *, low: float, high: float) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 with a scale of heights in its upper right corner.

    colours : (N, 3) uint8, of heights from `low` to `high` [m], evenly spaced
    """
    height, width = image.shape[:2]
    scale = height / 1000.0
    bar, top, length = max(8, round(BAR * scale)), round(70 * scale), round(320 * scale)
    left = width - bar - round(110 * scale)
    out = image.copy()
    shown = colours[np.linspace(len(colours) - 1, 0, length).round().astype(int)]
    out[top : top + length, left : left + bar] = shown[:, None]
    cv2.rectangle(out, (left, top), (left + bar, top + length), INK, 1)
    font = (cv2.FONT_HERSHEY_SIMPLEX, 1.25 * scale)
    thick = max(1, round(2 * scale))
    cv2.putText(out, "height [m]", (left - round(90 * scale), top - round(24 * scale)), *font, INK, thick, cv2.LINE_AA)
    for value in ticks(low, high):
        y = top + round(length * (1.0 - (value - low) / (high - low)))
        cv2.line(out, (left + bar, y), (left + bar + round(6 * scale), y), INK, 1)
        cv2.putText(out, f"{value:g}", (left + bar + round(10 * scale), y + round(12 * scale)), *font, INK, thick, cv2.LINE_AA)
    return out


def ticks(low: float, high: float, *, most: int = 6) -> list[float]:
    """List round numbers from `low` to `high`, at most `most` of them."""
    if not high > low:
        return []
    step = next((step for step in STEPS if (high - low) / step < most - 1), STEPS[-1])
    return [round(k * float(step), 6) + 0.0 for k in range(int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9)) + 1)]
