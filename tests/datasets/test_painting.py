"""Every painter of the simulated room: size, range, determinism, and detail that features can hold on to."""

import numpy as np
import pytest

from slamcli.datasets.simulated import brush, picture, texture

PAINTERS = {
    "flat": texture.flat((100, 120, 140)), "plaster": texture.plaster((220, 210, 200)), "wood": texture.wood((180, 140, 90)),
    "wood upright": texture.wood((180, 140, 90), along_x=False), "brick": texture.brick((180, 96, 76)),
    "stripes": texture.stripes(((200, 190, 180), (150, 140, 130), (90, 80, 70)), 0.1), "planks": texture.planks((190, 150, 100)),
    "tiles": texture.tiles((200, 195, 185)), "fabric": texture.fabric((60, 90, 120), (220, 200, 120)),
    "foliage": texture.foliage((90, 160, 70)), "repeated": texture.repeated(picture.mosaic, 0.25),
    "untextured": texture.untextured(picture.shapes),
    "shapes": picture.shapes, "landscape": picture.landscape, "notice": picture.notice, "mosaic": picture.mosaic, "window": picture.window,
    "door": picture.door((150, 110, 80)), "books": picture.books, "drawers": picture.drawers((150, 110, 80), 2, 2),
    "desk": picture.desk((150, 110, 80)), "cardboard": picture.cardboard, "screen": picture.screen,
    "wall": picture.wall(texture.plaster((200, 200, 200)), ((0.1, 0.1, 0.5, 0.4, picture.mosaic),)),
    "floor": picture.floor(texture.planks((190, 150, 100)), ((0.1, 0.1, 0.6, 0.4),)), "ceiling": picture.ceiling(((0.5, 0.4),)),
}  # fmt: skip
PLAIN = {"flat", "untextured", "plaster", "wood", "wood upright"}


@pytest.mark.parametrize("name", PAINTERS)
@pytest.mark.parametrize("scale", [20.0, 150.0])
def test_pictures_have_their_size_and_are_reproducible(name: str, scale: float) -> None:
    images = [PAINTERS[name](np.random.default_rng(5), 1.0, 0.8, scale) for _ in range(2)]
    assert np.array_equal(*images)
    assert images[0].dtype == np.uint8 and images[0].ndim == 3 and images[0].shape[2] == 3
    if name not in ("flat", "untextured", "repeated"):  # these may choose fewer pixels
        assert images[0].shape[:2] == (round(0.8 * scale), round(scale))


@pytest.mark.parametrize("name", sorted(set(PAINTERS) - PLAIN))
def test_pictures_have_contrast_and_differ_by_seed(name: str) -> None:
    first, second = (PAINTERS[name](np.random.default_rng(seed), 1.0, 0.8, 100.0).astype(int) for seed in (1, 2))
    assert first.std(axis=(0, 1)).max() > 6.0
    assert np.abs(first - second).mean() > 1.0


@pytest.mark.parametrize("name", PAINTERS)
def test_tiny_surfaces_can_be_painted(name: str) -> None:
    assert min(PAINTERS[name](np.random.default_rng(0), 0.02, 0.02, 40.0).shape[:2]) >= 1


def test_untextured_keeps_the_mean_colour_alone() -> None:
    flat = PAINTERS["untextured"](np.random.default_rng(3), 1.0, 0.8, 100.0)
    full = picture.shapes(np.random.default_rng(3), 1.0, 0.8, 100.0)
    assert (flat == flat[0, 0]).all()
    np.testing.assert_allclose(flat[0, 0], full.mean(axis=(0, 1)), atol=6)


def test_repeated_pictures_are_equal_to_the_pixel() -> None:
    image = texture.repeated(picture.mosaic, 0.5)(np.random.default_rng(0), 2.0, 0.4, 101.0)
    period = image.shape[1] // 4
    assert np.array_equal(image[:, :period], image[:, period : 2 * period])


def test_rectangle_covers_its_area() -> None:
    image = np.zeros((40, 60, 3), dtype=np.float32)
    brush.rectangle(image, 10.0, 1.03, 0.57, 2.22, 1.11, (100, 50, 0))
    np.testing.assert_allclose(image.sum(axis=(0, 1)), [22.2 * 11.1 * 100, 22.2 * 11.1 * 50, 0], rtol=1e-4)
    before = image.copy()
    for outside in ((-5.0, 0.0, 1.0, 1.0), (0.0, 9.0, 1.0, 1.0), (1.0, 1.0, -0.5, 1.0)):
        brush.rectangle(image, 10.0, *outside, (255, 255, 255))
    assert np.array_equal(image, before)


@pytest.mark.parametrize("at", [(-0.3, 0.2), (0.5, 0.5), (5.5, 3.9), (9.0, 9.0), (-9.0, 1.0)])
def test_text_and_pictures_are_cut_off_at_the_border(at: tuple[float, float]) -> None:
    image = np.zeros((40, 60, 3), dtype=np.float32)
    brush.write(image, 10.0, *at, 0.8, "word", (255, 255, 255))
    brush.paste(image, 10.0, *at, np.full((8, 8, 3), 9, np.uint8))
    assert image.shape == (40, 60, 3) and np.isfinite(image).all()
