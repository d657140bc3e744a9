"""Whether depth lies on colour, in recordings whose picture moves evenly: there many shifts fit with a lag of their own."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from slamcli.geometry.camera import Camera
from slamcli.inspection import registration

WIDTH, HEIGHT, RATE, N = 160, 120, 15.0, 48
SPEED = 24.0  # [px/s] of the picture, along x


@dataclass
class EvenMotion:
    """Bright posts before a dark wall pass by at one speed; depth is that of `late` frames before, or lies `dx` pixels to the right."""

    late: int = 0
    dx: int = 0
    camera: Camera = field(default_factory=lambda: Camera(width=WIDTH, height=HEIGHT, fx=140.0, fy=140.0, cx=79.5, cy=59.5))

    def __post_init__(self) -> None:
        rng = np.random.default_rng(5)
        self.stamp = self.depth_stamp = np.arange(N) / RATE
        self.depth_name = ["there"] * N
        n = WIDTH + int(SPEED * N / RATE) + 20
        self.is_post = np.zeros((HEIGHT, n), dtype=bool)
        for x in range(4, n - 12, 14):
            y, height = int(rng.integers(0, 60)), int(rng.integers(20, 60))
            self.is_post[y : y + height, x : x + int(rng.integers(5, 9))] = True
        self.light = rng.integers(0, 50, self.is_post.shape) + 130 * self.is_post

    def __len__(self) -> int:
        return N

    def grey(self, i: int) -> np.ndarray:
        return self.light[:, self._at(i)].astype(np.uint8)

    def depth(self, i: int) -> np.ndarray:
        posts = self.is_post[:, self._at(max(i - self.late, 0))]
        return np.roll(np.where(posts, 1.0, 2.0).astype(np.float32), self.dx, axis=1)

    def _at(self, i: int) -> slice:
        x = round(SPEED * i / RATE)
        return slice(x, x + WIDTH)


def test_a_sound_recording_is_found_so_wherever_the_search_began() -> None:
    recording = EvenMotion()
    fit = registration.measure(recording, workers=1)
    assert max(map(abs, fit.shift)) <= 1 and abs(fit.lag) <= 0.02
    colours, edges = registration.collect(recording, 1, registration.BLOCKS)
    for dx in (-2, 2, 4):  # as good a fit, by the motion
        shift, lag, is_plain = registration._or_plainer(colours, edges, (dx, 0), -dx / SPEED)
        assert is_plain and max(map(abs, shift)) <= 1 and abs(lag) <= 0.02


@pytest.mark.parametrize("late", [1, 2])
def test_a_late_one_is_told_by_its_lag_and_not_by_a_shift(late: int) -> None:
    fit = registration.measure(EvenMotion(late=late), workers=1)
    if late / RATE < registration.LAGS[-1]:
        assert max(map(abs, fit.shift)) <= 1
        assert fit.lag == pytest.approx(late / RATE, abs=0.04)
    else:  # further than lags are searched
        assert fit.lag is None or fit.lag > 0.05


def test_depth_that_lies_aside_is_told_by_its_shift() -> None:
    fit = registration.measure(EvenMotion(dx=6), workers=1)
    assert fit.shift[0] < -3 and abs(fit.shift[1]) <= 1
