"""Coarse depth images: what was kept comes back, in any order and number of threads; damage is told."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from boxroom import KINECT, look_along, render

from slamcli.depth import coarse_images, icp
from slamcli.depth.coarse_images import CoarseImages
from slamcli.errors import SlamError


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.stack([icp.coarsen(render(look_along([1.0, 1.5, 0.9], 0.1 * k, 0.2), KINECT)) for k in range(9)])


def test_what_was_kept_comes_back(images: np.ndarray) -> None:
    kept = CoarseImages(coarse_images.encode([*images, None], images[0].shape))
    assert kept.shape == (10, *images[0].shape) and len(kept) == 10 and kept.size == 10 * images[0].size
    np.testing.assert_array_equal(kept.of([7, 0, 7]), images[[7, 0, 7]])
    np.testing.assert_array_equal(kept[3], images[3])
    assert not kept[9].any() and kept.of([]).shape == (0, *images[0].shape)
    with pytest.raises(IndexError):
        kept[10]


def test_a_room_takes_less_than_half(images: np.ndarray) -> None:
    assert 0.1 < coarse_images.encode(images, images[0].shape).coarse_code.nbytes / images.nbytes < 0.5


def test_an_image_once_forgotten_is_decoded_again(images: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coarse_images, "KEPT", 2)
    kept, order = CoarseImages(coarse_images.encode(images, images[0].shape)), np.random.default_rng(0).integers(0, 9, 100)
    with ThreadPoolExecutor(3) as pool:
        for frame, image in zip(order, pool.map(kept.__getitem__, order), strict=True):
            np.testing.assert_array_equal(image, images[frame])


def test_images_may_be_changed_as_they_are_read(images: np.ndarray) -> None:
    kept = CoarseImages(coarse_images.encode(images, images[0].shape))
    doubled = kept.changed(lambda frame, image: image + np.uint16(frame))
    np.testing.assert_array_equal(doubled[4], images[4] + 4)
    np.testing.assert_array_equal(kept[4], images[4])


def test_a_camera_too_small_for_coarse_images_has_empty_ones() -> None:
    kept = CoarseImages(coarse_images.encode([None, None], (0, 0)))
    assert kept.size == 0 and kept[1].shape == (0, 0) and not kept[1].any()


def test_damage_is_told(images: np.ndarray) -> None:
    code = coarse_images.encode(images, images[0].shape)
    cut = replace(code, coarse_offset=np.minimum(code.coarse_offset, code.coarse_offset[5] - 40))
    with pytest.raises(SlamError, match=r"coarse_code.npy, frame 4: RVL image is damaged"):
        CoarseImages(cut)[4]
