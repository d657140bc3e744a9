"""RVL: an independent encoder, published codes, and bytes that are none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import rvl as encode

from slamcli.errors import SlamError
from slamcli.formats import rvl


def words(nibbles: str) -> bytes:
    """Pack nibbles, written from the first on, into little-endian words filled from the top."""
    padded = nibbles + "0" * (-len(nibbles) % 8)
    return b"".join(bytes.fromhex(padded[i : i + 8])[::-1] for i in range(0, len(padded), 8))


@pytest.mark.parametrize(
    ("values", "nibbles"),
    [
        ([0, 0, 0, 0], "40"),  # four zeros, no value
        ([1, 1, 2, 3, 5], "0520224"),  # no zero, five values: +1 0 +1 +1 +2, zigzag 2 0 2 2 4
        ([0, 7, 0], "116110"[:2] + "e1" + "10"),  # +7 is zigzag 14: 6 with more to come, then 1
        ([9, 0, 4], "01a211" + "91"),  # -5 is zigzag 9: 1 with more to come, then 1
    ],
)
def test_codes_worked_out_by_hand(values: list[int], nibbles: str) -> None:
    assert rvl.decode(words(nibbles), len(values), 1).ravel().tolist() == values


@settings(deadline=None, max_examples=60)
@given(st.lists(st.one_of(st.just(0), st.integers(0, 65535), st.integers(1000, 1010)), min_size=1, max_size=300))
def test_decoding_inverts_an_independent_encoder(values: list[int]) -> None:
    raw = np.array(values, dtype=np.uint16).reshape(1, -1)
    assert np.array_equal(rvl.decode(encode(raw), raw.shape[1], 1), raw)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.one_of(st.just(0), st.sampled_from([1, 65535]), st.integers(1000, 1010)), min_size=1, max_size=300))
def test_encoding_gives_the_bytes_of_an_independent_encoder(values: list[int]) -> None:
    raw = np.array(values, dtype=np.uint16).reshape(1, -1)
    assert rvl.encode(raw) == encode(raw)
    assert np.array_equal(rvl.decode(rvl.encode(raw), raw.shape[1], 1), raw)


@pytest.mark.parametrize("values", [[1, 65535] * 500, [0, 65535] * 500, [0, 1, 65535] * 500, [65535], [0], [0] * 3000 + [1]])
def test_the_worst_images_have_room(values: list[int]) -> None:
    raw = np.array(values, dtype=np.uint16).reshape(1, -1)
    assert np.array_equal(rvl.decode(rvl.encode(raw), raw.shape[1], 1), raw)


def test_cut_off_and_absurd_sizes_are_told() -> None:
    raw = np.random.default_rng(0).integers(0, 5000, (20, 30)).astype(np.uint16)
    data = encode(raw)
    for kept in (0, 4, len(data) // 2):
        with pytest.raises(SlamError, match="RVL"):
            rvl.decode(data[:kept], 30, 20)
    for size in ((0, 20), (1 << 20, 1 << 20), (31, 2000)):
        with pytest.raises(SlamError, match="RVL"):
            rvl.decode(data, *size)


@settings(deadline=None, max_examples=60)
@given(st.binary(min_size=1, max_size=64))
def test_any_bytes_give_an_image_or_an_error(data: bytes) -> None:
    try:
        found = rvl.decode(data, 9, 7)
    except SlamError:
        return
    assert found.shape == (7, 9)
