"""A scale of heights has round numbers within its ends, in order, and hides nothing but its corner."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.visualization import height_scale


@given(st.floats(-50, 50), st.floats(0.02, 60))
def test_ticks_are_round_few_and_within(low: float, span: float) -> None:
    found = height_scale.ticks(low, low + span)
    assert 1 <= len(found) <= 6 or span < 0.03
    assert found == sorted(found)
    assert all(low - 1e-6 <= value <= low + span + 1e-6 for value in found)


def test_a_room_is_marked_in_half_metres() -> None:
    assert height_scale.ticks(-0.03, 1.9) == [0.0, 0.5, 1.0, 1.5]
    assert height_scale.ticks(1.0, 1.0) == []


@pytest.mark.parametrize("size", [(800, 1200), (300, 300)])
def test_the_bar_shows_the_colours_from_high_to_low(size: tuple[int, int]) -> None:
    image = np.full((*size, 3), 200, np.uint8)
    colours = np.stack([np.arange(256), np.zeros(256), np.zeros(256)], axis=1).astype(np.uint8)
    drawn = height_scale.add(image, colours, low=0.0, high=2.0)
    is_bar = (drawn[..., 1] == 0) & (drawn[..., 2] == 0)
    column = np.argmax(is_bar.sum(axis=0))
    shades = drawn[is_bar[:, column], column, 0].astype(int)
    assert shades[0] > 240 and shades[-1] < 15
    assert (np.diff(shades) <= 0).all()
    np.testing.assert_array_equal(drawn[size[0] // 2 :], image[size[0] // 2 :])
    np.testing.assert_array_equal(drawn[:, : size[1] // 2], image[:, : size[1] // 2])
