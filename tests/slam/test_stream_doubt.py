"""Streams that stand still, depth without sense, units of no camera: found where they are, and nowhere else."""

import numpy as np
import pytest
from boxroom import KINECT, kinect_noise, look_along, render

from slamcli.datasets import depth_unit
from slamcli.depth import coarse_images
from slamcli.depth.coarse_images import CoarseImages
from slamcli.slam import stream_doubt

RATE = 15.0  # [Hz]


def view(seed: int = 0) -> np.ndarray:
    """Depth of a simulated room, with a sensor's noise."""
    return kinect_noise(render(look_along([1.5, 1.5, 0.7], 0.3 + 0.1 * seed, 0.2), KINECT), np.random.default_rng(seed))


def spans(colour: list[int], depth: list[int]) -> dict[str, tuple[str, bool]]:
    stamp = np.arange(len(colour)) / RATE
    found = stream_doubt.about_motion(stamp, np.array(colour, dtype=bool), np.array(depth, dtype=bool))
    return {one.name: (one.text, one.is_grave) for one in found}


def test_depth_of_a_room_has_nothing_against_it() -> None:
    images = [stream_doubt.look(view(seed)) for seed in range(4)]
    assert stream_doubt.about_readings(images) == []
    assert all(0.001 < image.roughness < 0.02 and image.spread > 0.5 and image.share > 0.5 for image in images)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda depth, rng: np.full_like(depth, np.nan), "none of 4"),
        (lambda depth, rng: np.where(np.isnan(depth), depth, np.float32(2.0)), "one distance"),
        (lambda depth, rng: rng.uniform(0.2, 5.0, depth.shape).astype(np.float32), "noise"),
        (lambda depth, rng: rng.permutation(depth.ravel()).reshape(depth.shape), "noise"),
    ],
    ids=["empty", "constant", "random", "shuffled"],
)
def test_depth_that_is_no_depth_is_told(change, word: str) -> None:
    rng = np.random.default_rng(1)
    found = stream_doubt.about_readings([stream_doubt.look(change(view(seed), rng)) for seed in range(4)])
    assert [one.name for one in found] == ["depth_readings"] and found[0].is_grave and word in found[0].text


def test_a_single_bad_image_is_no_doubt_about_all() -> None:
    images = [stream_doubt.look(view(seed)) for seed in range(4)]
    flat = stream_doubt.look(np.full((120, 160), 2.0, dtype=np.float32))
    assert stream_doubt.about_readings([*images, flat, stream_doubt.NO_READINGS, None]) == []


def test_frames_without_any_depth_image_are_another_matter() -> None:
    assert stream_doubt.about_readings([None, None]) == []


def test_a_frozen_stream_is_named_with_its_frames() -> None:
    still = [0] * 10 + [1] * 15 + [0] * 5
    moving = [0] * 30
    assert spans(moving, moving) == {}
    found = spans(moving, still)
    assert list(found) == ["frozen_depth"] and "frames 9 to 24 " in found["frozen_depth"][0] and found["frozen_depth"][1]
    assert list(spans(still, moving)) == ["frozen_colour"]
    assert list(spans(still, still)) == ["frozen"]


def test_equal_images_of_a_raised_rate_are_no_fault() -> None:
    """30 Hz out of 10: each image three times."""
    assert spans([0, 1, 1] * 20, [0, 1, 1] * 20) == {}


def test_a_short_stop_does_not_put_all_in_doubt() -> None:
    found = spans([0] * 80, [0] * 20 + [1] * 8 + [0] * 52)
    assert list(found) == ["frozen_depth"] and not found["frozen_depth"][1]


def test_equal_depth_images_are_found_and_empty_or_flat_ones_are_none() -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(5000, 20000, (6, 8)).astype(np.uint16) for _ in range(3)]
    nothing, flat = np.zeros((6, 8), np.uint16), np.full((6, 8), 9000, np.uint16)
    kept = [images[0], images[0], images[1], images[1], images[2], nothing, nothing, flat, flat, None, None]
    same = stream_doubt.same_depth(CoarseImages(coarse_images.encode(kept, nothing.shape)))
    assert same.tolist() == [False, True, False, True] + [False] * 7


@pytest.mark.parametrize(("factor", "likely"), [(1.0, None), (1.5, 7500.0), (1 / 1.5, 3400.0), (1.3, 6500.0)])
def test_a_scale_that_makes_no_known_camera_is_told_with_the_right_one(factor: float, likely: float | None) -> None:
    metres = 1.0 / np.arange(1.0 / 5.0, 1.0 / 1.2, 1.0 / 348.0)  # the steps of a Kinect's disparity
    counts = np.bincount(np.rint(np.tile(metres, 50) * 5000 * factor).astype(int), minlength=65536)
    found = stream_doubt.about_unit(counts, 5000.0)
    assert [one.name for one in found] == (["depth_scale"] if likely else [])
    if likely:
        assert found[0].is_grave and f"camera.depth_scale = {likely:g} is right" in found[0].text
        assert depth_unit.judge(counts, 5000.0).likely_scale == likely
        assert stream_doubt.about_unit(counts, 5000.0 * factor) == []
