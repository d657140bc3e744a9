"""The detector as a whole: what it promises on pictures and on what is no picture."""

from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from textures import texture

from slamcli.config.options import ExtractConfig
from slamcli.errors import SlamError
from slamcli.vision import orb, pyramid
from slamcli.vision.comparison import evenness, plain_orb, side_by_side


def check(points: orb.KeyPoints, grey: np.ndarray, wanted: int) -> None:
    n = len(points)
    assert n <= wanted
    assert [a.dtype for a in (points.xy, points.octave, points.angle, points.response, points.desc)] == ["f4", "u1", "f4", "f4", "u1"]
    assert points.xy.shape == (n, 2) and points.desc.shape == (n, 32)
    assert len(points.octave) == len(points.angle) == len(points.response) == n
    assert (np.diff(points.octave.astype(int)) >= 0).all()
    assert (points.xy >= 0).all() and (points.xy <= np.array(grey.shape[::-1]) - 1).all()
    assert (np.abs(points.angle) <= np.float32(np.pi)).all() and np.isfinite(points.response).all()


@pytest.mark.parametrize(
    "options", [{}, {"smooth": False, "subpixel": False, "pool": 0, "rank_by": "sum", "fast_threshold": 20, "fast_threshold_low": 7}]
)
def test_as_many_points_as_wanted_and_the_same_every_time(options: dict) -> None:
    grey = texture(3, 240, 320)
    points = orb.detect(grey, ExtractConfig(features=300, **options))
    check(points, grey, 300)
    assert len(points) == 300 and len(np.unique(points.octave)) >= 5
    again = orb.detect(np.asfortranarray(grey), ExtractConfig(features=300, **options))
    for name in ("xy", "octave", "angle", "response", "desc"):
        np.testing.assert_array_equal(getattr(points, name), getattr(again, name))


@pytest.mark.parametrize("shape", [(0, 0), (0, 9), (1, 1), (3, 640), (38, 38), (39, 39), (39, 640), (640, 40)])
def test_small_and_narrow_images_give_few_points_or_none(shape: tuple[int, int]) -> None:
    grey = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    points = orb.detect(grey)
    check(points, grey, 1000)
    assert len(points) == 0 or min(shape) >= 39


@pytest.mark.parametrize("grey", [0, 127, 255])
def test_blank_images_give_none(grey: int) -> None:
    assert len(orb.detect(np.full((120, 160), grey, np.uint8))) == 0


def test_noise_and_checks_of_full_contrast_are_survived() -> None:
    rng = np.random.default_rng(1)
    checks = np.kron(np.indices((30, 40)).sum(axis=0) % 2, np.ones((4, 4))).astype(np.uint8) * 255
    for grey in (rng.integers(0, 2, (120, 160)).astype(np.uint8) * 255, rng.integers(0, 256, (120, 160)).astype(np.uint8), checks):
        check(orb.detect(grey), grey, 1000)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((60, 80), np.uint16),
        np.zeros((60, 80, 3), np.uint8),
        np.zeros((60, 80), np.float32),
        np.zeros(60, np.uint8),
        None,
        np.zeros((50, 16385), np.uint8),
    ],
    ids=["16 bits", "colour", "float", "a row", "nothing", "too wide"],
)
def test_what_is_no_grey_image_is_a_clear_error(wrong: object) -> None:
    with pytest.raises(SlamError, match="key points need an") as caught:
        orb.detect(wrong)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("octave", [0, 3, 7])
def test_a_levels_pixels_map_back_without_a_shift(octave: int) -> None:
    """A blob drawn at a known place has its centre there on every level."""
    v, u = np.mgrid[0:480, 0:640]
    grey = (255 * np.exp(-((u - 300.4) ** 2 + (v - 210.7) ** 2) / 200)).astype(np.uint8)
    box = pyramid.boxes(480, 640, levels=8, scale=1.2, least=1)
    canvas = pyramid.canvas(box)
    pyramid.fill(pyramid.levels(canvas, box), grey)
    image, top = pyramid.levels(canvas, box)[octave].astype(np.float64), box[octave, pyramid.TOP]
    y, x = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    centre = np.array([[(image * x).sum(), (image * (y + top)).sum()]]) / image.sum()
    np.testing.assert_allclose(pyramid.FullSize(box)(centre, np.array([octave], np.uint8)), [[300.4, 210.7]], atol=0.05)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 300), st.integers(0, 300), st.integers(1, 12), st.floats(1.05, 2.0))
def test_levels_shrink_by_the_scale_and_lie_beneath_each_other(height: int, width: int, levels: int, scale: float) -> None:
    box = pyramid.boxes(height, width, levels=levels, scale=scale, least=39)
    assert len(box) <= levels
    for octave, (top, h, w) in enumerate(box.tolist()):
        assert top == box[:octave, pyramid.HEIGHT].sum() and min(h, w) >= 39
        assert abs(h - height / scale**octave) <= 0.5 and abs(w - width / scale**octave) <= 0.5
    if len(box) < levels:
        assert min(height, width) / scale ** len(box) < 39.5


def test_images_of_other_sizes_between_change_nothing() -> None:
    """A thread keeps the memory it works in: what the last image left there must not show."""
    greys = [texture(3, 240, 320), texture(5, 333, 201), np.full((240, 320), 7, np.uint8)]
    first = orb.detect(greys[0], ExtractConfig(features=300))
    for grey in greys[1:]:
        orb.detect(grey, ExtractConfig(features=300))
        again = orb.detect(greys[0], ExtractConfig(features=300))
        for name in ("xy", "octave", "angle", "response", "desc"):
            np.testing.assert_array_equal(getattr(again, name), getattr(first, name))


def test_points_come_back_where_a_warp_takes_them() -> None:
    """Half a pixel over all levels; plain ORB on the same pictures is the peer."""
    grey = texture(17, 480, 640)
    H = np.array([[1.03, -0.06, 12.3], [0.05, 0.98, -7.8], [2e-5, -1e-5, 1.0]])
    moved = cv2.warpPerspective(grey, H, (640, 480), flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT)
    error = {}
    for name, detect in (("ours", orb.detect), ("plain", plain_orb)):
        a, b = detect(grey), detect(moved)
        pairs = [
            (m.queryIdx, m.trainIdx) for m in cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a.desc, b.desc) if m.distance < 50
        ]
        rows = np.array(pairs)
        true = cv2.perspectiveTransform(a.xy[rows[:, 0]].astype(np.float64)[None], H)[0]
        distance = np.linalg.norm(true - b.xy[rows[:, 1]], axis=1)
        error[name] = np.median(distance[distance < 5])
    assert 0.0 < error["ours"] < 0.5
    assert error["ours"] < 0.6 * error["plain"]


def test_points_are_spread_more_evenly_than_plain_orbs_and_the_fewer_weak_ones_are_allowed_the_less() -> None:
    grey = np.full((480, 640), 120, np.uint8)
    rng = np.random.default_rng(5)
    rough, faint = (cv2.GaussianBlur(rng.normal(0, 1, shape), (0, 0), 2) * 7 for shape in ((160, 200), (240, 640)))
    grey[40:200, 60:260] = np.clip(128 + 60 * rough, 0, 255)  # a bunch of strong texture above faint texture
    grey[240:, :] = 110 + 8 * faint
    none, ours, every, plain = (
        evenness(detect(grey).xy, 640, 480)
        for detect in (
            partial(orb.detect, settings=ExtractConfig(weak=0.0)),
            orb.detect,
            partial(orb.detect, settings=ExtractConfig(weak=1.0)),
            plain_orb,
        )
    )
    assert ours.share >= 1.5 * plain.share and ours.ratio <= 0.75 * plain.ratio
    assert every.share >= 1.5 * ours.share and every.ratio <= 0.5 * plain.ratio
    assert none.share < 0.5 * ours.share


def test_evenness_of_known_spreads() -> None:
    even = evenness(np.array([[x, y] for x in range(14, 600, 30) for y in range(14, 300, 30)]), 600, 300)
    assert even.share == 1.0 and even.ratio == 0.0
    heap = evenness(np.full((100, 2), 50.0), 600, 300)
    assert heap.share == pytest.approx(1 / 200) and heap.ratio == pytest.approx(99.5)
    assert evenness(np.zeros((0, 2)), 600, 300).share == 0.0 and np.isnan(evenness(np.zeros((0, 2)), 600, 300).ratio)


def test_the_picture_shows_both() -> None:
    grey = texture(4, 120, 160)
    picture = side_by_side(grey, plain_orb(grey, 200), orb.detect(grey, ExtractConfig(features=200)))
    assert picture.shape == (148, 328, 3) and picture.dtype == np.uint8


def test_each_key_point_is_drawn_where_it_is() -> None:
    grey = texture(4, 120, 160)
    plain, ours = plain_orb(grey, 200), orb.detect(grey, ExtractConfig(features=200))
    picture = side_by_side(grey, plain, ours).astype(int)
    is_drawn = picture[:, :, 1] - picture[:, :, 2] > 40
    for points, left in ((plain, 0), (ours, 168)):
        assert len(points) > 20
        for (x, y), octave in zip(points.xy, points.octave, strict=True):
            u, v, reach = int(x) + left, int(y) + 28, int(np.ceil(2.5 * 1.2 ** float(octave))) + 1
            assert is_drawn[v - reach : v + reach + 1, u - reach : u + reach + 1].any()
    assert not is_drawn[:28].any() and not is_drawn[:, 160:168].any()


@pytest.mark.parametrize(
    "available, expected",
    [([500, 500], [67, 33]), ([50, 500], [50, 50]), ([500, 10], [90, 10]), ([10, 10], [10, 10]), ([0, 0], [0, 0])],
)
def test_what_a_level_lacks_goes_to_the_others(available: list[int], expected: list[int]) -> None:
    assert orb.shares(100, [200, 100], available) == expected
