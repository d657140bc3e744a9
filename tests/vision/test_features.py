"""Corners, spreading, orientation, descriptors: kernels against their twins and against OpenCV."""

import cv2
import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from textures import texture

from slamcli.vision import brief, fast, filters, pyramid, quadtree
from slamcli.vision.pattern import PAIRS

seeds = st.integers(0, 2**32 - 1)


def canvas_of(*images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put images one beneath the other on a canvas, in the midst of bytes left over from others; give it and their boxes."""
    height = [len(image) for image in images]
    box = np.array([(sum(height[:k]), *image.shape) for k, image in enumerate(images)], dtype=np.int64)
    canvas = stale(np.empty((sum(height), -(-max(image.shape[1] for image in images) // 8) * 8), np.uint8))
    for k, image in enumerate(images):
        pyramid.levels(canvas, box)[k][:] = image
    return canvas, box


def stale(canvas: np.ndarray) -> np.ndarray:
    canvas[:] = np.random.default_rng(99).integers(0, 256, canvas.shape)
    return canvas


def apply(blur, image: np.ndarray) -> np.ndarray:
    canvas, box = canvas_of(image)
    out = stale(np.empty_like(canvas))
    blur(canvas, box, out)
    return pyramid.levels(out, box)[0]


def score_of(image: np.ndarray, margin: int = fast.RADIUS) -> np.ndarray:
    """The score of one level, 0 in its margin."""
    canvas, box = canvas_of(image)
    out = np.zeros_like(canvas)
    fast.corner_score(canvas, box, margin, out)
    return pyramid.levels(out, box)[0]


def corners_of(image: np.ndarray, *, border: int = 19, at_most: int = 0, **options) -> fast.Corners:
    canvas, box = canvas_of(image)
    return fast.Finder(box, border=border).corners(canvas, at_most=np.array([at_most]), **options)


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(7, 24), st.integers(7, 40))
def test_the_fast_score_is_that_of_the_definition(seed: int, height: int, width: int) -> None:
    image = texture(seed, height, width)
    np.testing.assert_array_equal(score_of(image), naive.fast_score(image))


@settings(max_examples=15, deadline=None)
@given(seeds, st.booleans(), st.sampled_from(["sum", "fast"]))
def test_levels_on_one_canvas_do_not_touch_each_other(seed: int, bounded: bool, rank_by: str) -> None:
    rng = np.random.default_rng(seed)
    images = [texture(seed + k, *rng.integers(39, 80, 2)) for k in range(3)]
    canvas, box = canvas_of(*images)
    for blur, edge in ((filters.blur_1px, 2), (filters.blur_2px, 0)):
        out = stale(np.empty_like(canvas))
        blur(canvas, box, out)
        for k, image in enumerate(images):
            inner = (slice(edge, image.shape[0] - edge), slice(edge, image.shape[1] - edge))
            np.testing.assert_array_equal(pyramid.levels(out, box)[k][inner], apply(blur, image)[inner])
    options = {"cell": 13, "threshold": 20, "threshold_low": 5, "rank_by": rank_by}
    at_most, wanted = (20, 3, 9) if bounded else (0, 0, 0), [5, 0, 11]
    together = fast.Finder(box, border=19).corners(canvas, at_most=np.array(at_most), **options)
    roots = np.array([(19, top + 19, width - 19, top + height - 19) for top, height, width in box], dtype=np.int32)
    rows, octave = quadtree.choose(together.xy, together.response, together.first, roots, wanted)
    for k, image in enumerate(images):
        alone = corners_of(image, at_most=at_most[k], **options)
        span = slice(together.first[k], together.first[k + 1])
        np.testing.assert_array_equal(together.xy[span] - [0, box[k, pyramid.TOP]], alone.xy)
        np.testing.assert_array_equal(together.response[span], alone.response)
        expected = spread_of(alone.xy, alone.response, (19, 19, image.shape[1] - 19, image.shape[0] - 19), wanted[k])
        np.testing.assert_array_equal(rows[octave == k] - together.first[k], expected)


def test_memory_used_again_changes_nothing() -> None:
    """The second image is found as by a finder that never saw the first."""
    images = [texture(seed, 70, 90) for seed in (1, 3)]
    options = {"cell": 9, "threshold": 30, "threshold_low": 5, "at_most": np.array([40])}
    canvas, box = canvas_of(images[0])
    finder = fast.Finder(box, border=19)
    finder.corners(canvas, **options)
    again, fresh = finder.corners(canvas_of(images[1])[0], **options), corners_of(images[1], **{**options, "at_most": 40})
    assert len(fresh.xy) >= 10
    np.testing.assert_array_equal(again.xy, fresh.xy)
    np.testing.assert_array_equal(again.response, fresh.response)
    np.testing.assert_array_equal(again.summits(np.arange(len(again.xy))), fresh.summits(np.arange(len(fresh.xy))))


@settings(max_examples=25, deadline=None)
@given(seeds, st.sampled_from([0.0, 0.1, 0.3, 1.0]), st.sampled_from([10, 60, 5000]))
def test_of_the_corners_that_empty_cells_give_the_strongest_stay_as_many_as_are_allowed_or_left_open(
    seed: int, weak: float, at_most: int
) -> None:
    image = texture(seed, 120, 160)
    image[:, 80:] = image[:, 80:] // 4 + 90
    options = {"cell": 6, "threshold": 30, "threshold_low": 3, "at_most": at_most, "rank_by": "fast"}
    every, found, none = (
        {(x, y): s for (x, y), s in zip(of.xy.tolist(), of.response.tolist(), strict=True)}
        for of in (corners_of(image, weak=share, **options) for share in (5000.0, weak, 0.0))
    )
    is_raised = len({at for at, s in every.items() if s > 30}) > at_most
    strong = set(none) if is_raised else {at for at, s in every.items() if s > 30}
    left_out = {s for at, s in every.items() if at not in found}
    n_weak, allowed = len(found.keys() - strong), max(weak * at_most, 0 if is_raised else at_most - len(strong))
    assert strong <= found.keys() <= every.keys() and n_weak <= allowed
    # All of the next strength together would be too many.
    if left_out:
        assert all(found[at] > max(left_out) for at in found.keys() - strong)
        assert n_weak + sum(s == max(left_out) for at, s in every.items() if at not in strong) > allowed


def test_a_faint_picture_gives_all_it_has() -> None:
    faint = texture(3, 240, 320) // 8 + 100
    every, few = (corners_of(faint, cell=12, threshold=30, threshold_low=2, at_most=1000, weak=weak) for weak in (1.0, 0.0))
    assert 100 < len(every.xy) == len(few.xy) < 1000


def hostile() -> dict[str, np.ndarray]:
    """Pictures at the ends of what 8 bits can hold, and such with very many equal scores."""
    v, u = np.mgrid[0:52, 0:58]
    lone = np.zeros((52, 58), np.uint8)
    lone[25, 30] = 255
    return {
        "black": np.zeros((52, 58), np.uint8),
        "white": np.full((52, 58), 255, np.uint8),
        "lone bright pixel": lone,
        "lone dark pixel": 255 - lone,
        "saturated noise": np.random.default_rng(0).choice(np.array([0, 255], np.uint8), (52, 58)),
        "checks of one pixel": ((u + v) % 2 * 255).astype(np.uint8),
        "stripes": (u // 3 % 2 * 255).astype(np.uint8),
        "dots": ((u % 9 == 4) & (v % 9 == 4)).astype(np.uint8) * 200,
    }


@pytest.mark.parametrize("name", hostile())
def test_on_hostile_pictures_each_kernel_is_its_twin(name: str) -> None:
    image = hostile()[name]
    score = score_of(image)
    np.testing.assert_array_equal(score, naive.fast_score(image))
    peak = naive.local_maxima(score, 5)
    for only_best in (False, True):
        found = corners_of(image, cell=7, threshold=40, threshold_low=5, at_most=image.size if only_best else 0)
        assert [tuple(at) for at in found.xy.tolist()] == naive.cell_corners(peak, 19, 7, 40, only_best)
    places = found.summits(np.arange(len(found.xy)))
    assert np.isfinite(places).all() and (np.abs(places - found.xy) <= 1).all()
    smooth = apply(filters.blur_2px, image)
    np.testing.assert_array_equal(smooth, cv2.GaussianBlur(image, (7, 7), 2, sigmaY=2, borderType=cv2.BORDER_REFLECT_101))
    xy = np.array([[19, 19], [38, 32], [30, 25], [31, 26]], np.int32)
    angle = brief.orientation(image, xy)
    np.testing.assert_allclose(angle, [naive.orientation(image, x, y, brief._disc()) for x, y in xy], atol=1e-6)
    np.testing.assert_array_equal(
        brief.descriptors(smooth, xy, angle), [naive.brief(smooth, x, y, a, PAIRS) for (x, y), a in zip(xy, angle, strict=True)]
    )


def test_a_margin_leaves_the_inside_as_it_is() -> None:
    image = texture(1, 40, 50)
    whole, inside = score_of(image), score_of(image, 12)
    np.testing.assert_array_equal(inside[12:-12, 12:-12], whole[12:-12, 12:-12])
    inside[12:-12, 12:-12] = 0
    assert not inside.any()


@pytest.mark.parametrize("threshold", [1, 7, 20, 60])
def test_a_corner_is_where_opencv_finds_one(threshold: int) -> None:
    image = texture(3, 120, 160)
    score = score_of(image)
    expected = np.zeros(image.shape, dtype=bool)
    for point in cv2.FastFeatureDetector_create(threshold, False).detect(image):
        expected[int(point.pt[1]), int(point.pt[0])] = True
    assert expected.any()
    np.testing.assert_array_equal(score > threshold, expected)


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_a_constant_image_has_no_corner(grey: int) -> None:
    found = corners_of(np.full((90, 120), grey, np.uint8), cell=30, threshold=20, threshold_low=1)
    assert len(found.xy) == len(found.response) == 0


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(40, 90), st.integers(40, 90), st.sampled_from([7, 30, 200]), st.booleans())
def test_cells_fall_back_as_the_twin_says(seed: int, height: int, width: int, cell: int, only_best: bool) -> None:
    image, (high, low) = texture(seed, height, width), (25, 5)
    score = score_of(image)
    peak = naive.local_maxima(score, low)
    room = height * width
    expected = naive.cell_corners(peak, 19, cell, high, only_best)
    found = corners_of(image, cell=cell, threshold=high, threshold_low=low, at_most=room if only_best else 0)
    assert [tuple(at) for at in found.xy.tolist()] == expected


def test_the_threshold_rises_until_about_as_many_corners_are_left_as_asked_for() -> None:
    image = texture(12, 240, 320)
    every = corners_of(image, cell=400, threshold=5, threshold_low=5, rank_by="fast")
    strongest = corners_of(image, cell=400, threshold=5, threshold_low=5, at_most=100, rank_by="fast")
    assert 100 <= len(strongest.xy) < len(every.xy)
    least = strongest.response.min()
    assert (every.response > least).sum() < 100, "a higher threshold would have left too few"
    assert len(strongest.xy) == (every.response >= least).sum()


def test_the_response_is_the_papers_sum() -> None:
    image = texture(5, 100, 100)
    found = corners_of(image, cell=30, threshold=10, threshold_low=5)
    grey = image.astype(int)
    expected = [sum(abs(grey[y + dy, x + dx] - grey[y, x]) for dx, dy in naive.CIRCLE) for x, y in found.xy]
    np.testing.assert_array_equal(found.response, expected)


@pytest.mark.parametrize("shift", [(0.3, -0.4), (-0.25, 0.1), (0.5, 0.5)])
def test_the_summit_follows_a_shift_of_less_than_a_pixel(shift: tuple[float, float]) -> None:
    tiles = np.kron(np.random.default_rng(8).uniform(40, 220, (50, 50)), np.ones((40, 40)))  # four times as fine as the images
    images = []
    for dx, dy in ((0, 0), shift):
        turned = np.float32([[0.9, -0.4, 300 + 4 * dx], [0.4, 0.9, -300 + 4 * dy]])
        moved = cv2.warpAffine(tiles, turned, (1280, 960), flags=cv2.INTER_LINEAR)
        image = cv2.resize(cv2.GaussianBlur(moved, (0, 0), 3), (320, 240), interpolation=cv2.INTER_AREA).astype(np.uint8)
        images.append(apply(filters.blur_1px, image))
    a, b = (corners_of(image, cell=30, threshold=8, threshold_low=5) for image in images)
    apart = (b.xy[None] - a.xy[:, None]).astype(float)
    nearest = np.abs(apart).sum(axis=2).argmin(axis=1)
    whole = apart[np.arange(len(nearest)), nearest]
    is_same = np.abs(whole).max(axis=1) <= 1
    fine = b.summits(nearest) - a.summits(np.arange(len(nearest)))
    assert is_same.sum() > 100
    rough, better = (np.sqrt(np.mean((moved[is_same] - shift) ** 2)) for moved in (whole, fine))
    assert 0.0 < better < 0.6 * rough


def spread_of(xy: np.ndarray, response: np.ndarray, root: tuple[int, int, int, int], wanted: int) -> np.ndarray:
    return quadtree.choose(xy, response, np.array([0, len(xy)]), np.array([root], dtype=np.int32), [wanted])[0]


points = st.integers(0, 60).flatmap(lambda n: st.tuples(st.just(n), seeds, st.integers(0, 80)))


@settings(max_examples=80, deadline=None)
@given(points)
def test_the_quadtree_chooses_as_its_twin(case: tuple[int, int, int]) -> None:
    n, seed, wanted = case
    rng = np.random.default_rng(seed)
    width, height = int(rng.integers(12, 90)), int(rng.integers(12, 60))
    place = rng.choice(width * height, n, replace=False)
    xy = np.stack([place % width, place // width], axis=1).astype(np.int32) + np.int32(19)
    response = rng.integers(0, 8, n).astype(np.float32)  # many equal
    root = (19, 19, 19 + width, 19 + height)
    chosen = spread_of(xy, response, root, wanted)
    assert chosen.tolist() == naive.quadtree(xy.tolist(), response.tolist(), root, wanted)
    assert len(chosen) == min(n, wanted) or n > wanted


def test_the_quadtree_spreads_a_bunch_and_keeps_the_lonely() -> None:
    rng = np.random.default_rng(0)
    place = rng.choice(1600, 400, replace=False)
    bunch = np.stack([20 + place % 40, 20 + place // 40], axis=1)
    lonely = np.array([[500, 40], [40, 400], [600, 450]])
    xy = np.concatenate([bunch, lonely]).astype(np.int32)
    response = np.concatenate([np.full(400, 100.0), np.full(3, 1.0)]).astype(np.float32)
    chosen = spread_of(xy, response, (0, 0, 640, 480), 30)
    assert {400, 401, 402} <= set(chosen.tolist())
    assert len(chosen) == 30


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(4, 40), st.integers(4, 40))
def test_the_wide_blur_is_opencvs_to_the_bit(seed: int, height: int, width: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)
    np.testing.assert_array_equal(
        apply(filters.blur_2px, image), cv2.GaussianBlur(image, (7, 7), 2, sigmaY=2, borderType=cv2.BORDER_REFLECT_101)
    )


def test_the_narrow_blur_is_the_binomial_rounded() -> None:
    image = texture(2, 30, 41)
    weights = np.array([1, 4, 6, 4, 1])
    exact = cv2.sepFilter2D(image.astype(np.float64), -1, weights, weights, borderType=cv2.BORDER_REFLECT_101)
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_array_equal(apply(filters.blur_1px, image)[inner], np.floor(exact / 256 + 0.5)[inner])


def test_the_disc_is_that_of_opencv() -> None:
    """The half widths in modules/features2d/src/orb.cpp, by its own loop."""
    half = [round(np.sqrt(15**2 - v * v)) for v in range(12)] + [0] * 4
    row = 0
    for v in range(15, 10, -1):
        while half[row] == half[row + 1]:
            row += 1
        half[v] = row
        row += 1
    assert half == [15, 15, 15, 15, 14, 14, 14, 13, 13, 12, 11, 10, 9, 8, 6, 3]
    np.testing.assert_array_equal(brief._disc(), half)


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_orientation_and_descriptor_are_those_of_the_twins(seed: int) -> None:
    image = texture(seed, 60, 70)
    rng = np.random.default_rng(seed)
    xy = np.stack([rng.integers(19, 51, 6), rng.integers(19, 41, 6)], axis=1).astype(np.int32)
    angle = brief.orientation(image, xy)
    np.testing.assert_allclose(angle, [naive.orientation(image, x, y, brief._disc()) for x, y in xy], atol=1e-6)
    smooth = apply(filters.blur_2px, image)
    expected = [naive.brief(smooth, x, y, a, PAIRS) for (x, y), a in zip(xy, angle, strict=True)]
    np.testing.assert_array_equal(brief.descriptors(smooth, xy, angle), expected)


def test_descriptors_and_orientations_are_opencvs_on_every_level() -> None:
    """OpenCV takes a point's pixel of the full-size image over the level's scale: so the places given to it are level pixels times scale."""
    grey = texture(21, 240, 320)
    plain = cv2.ORB_create(500, edgeThreshold=19, patchSize=31)
    points = []
    for octave in range(4):
        for x, y in np.random.default_rng(octave).integers(40, 130, (40, 2)):
            points.append(cv2.KeyPoint(float(x) * 1.2**octave, float(y) * 1.2**octave, 31.0, 0.0, 1.0, octave))
    box = pyramid.boxes(240, 320, levels=8, scale=1.2, least=1)
    canvas = pyramid.canvas(box)
    pyramid.fill(pyramid.levels(canvas, box), grey)
    images = [np.ascontiguousarray(pyramid.levels(canvas, box)[octave]) for octave in range(8)]
    ours = []
    for point in points:
        xy = np.rint(np.array([point.pt]) / 1.2**point.octave).astype(np.int32)
        angle = brief.orientation(images[point.octave], xy)
        point.angle = float(np.rad2deg(angle[0])) % 360
        ours.append(brief.descriptors(apply(filters.blur_2px, images[point.octave]), xy, angle)[0])
    kept, theirs = plain.compute(grey, points)
    assert len(kept) == len(points)
    order = {(p.pt, p.octave): k for k, p in enumerate(points)}
    same = [np.unpackbits(~(theirs[k] ^ ours[order[p.pt, p.octave]])).mean() for k, p in enumerate(kept)]
    assert np.mean(same) >= 0.99


def test_the_pattern_is_as_published() -> None:
    assert PAIRS.shape == (256, 2, 2)
    assert PAIRS[0].ravel().tolist() == [8, -3, 9, 5]
    assert PAIRS[-1].ravel().tolist() == [-1, -6, 0, -11]
    assert np.hypot(*np.moveaxis(PAIRS.astype(float), -1, 0)).max() <= brief.BORDER - 0.5
