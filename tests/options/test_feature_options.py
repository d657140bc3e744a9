"""What the options of extract and match do, in the direction that their help promises."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scenes import observe, room_points, sweep

from slamcli import artifacts
from slamcli.config.options import ExtractConfig, MatchConfig
from slamcli.formats import vocabulary_file
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Flow, Matches, Words
from slamcli.stages import extract, match
from slamcli.vision import kmeans, orb


def tiles(*, contrast: float = 120.0, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """A picture (240, 320) full of corners."""
    rng = np.random.default_rng(seed)
    coarse = (128 + contrast * (rng.random((24, 32)) - 0.5)).astype(np.float32)
    fine = cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_NEAREST)
    return np.clip(fine + rng.normal(0, noise, fine.shape) if noise else fine, 0, 255).astype(np.uint8)


def squares(*, at: list[tuple[int, int]], contrast: int) -> np.ndarray:
    """A grey picture (240, 320) with small squares at columns and rows `at`."""
    grey = np.full((240, 320), 100, np.uint8)
    for u, v in at:
        grey[v : v + 8, u : u + 8] = 100 + contrast
    return grey


STRONG, WEAK = squares(at=[(60, 60)], contrast=120), squares(at=[(60, 60)], contrast=14)
BOTH = squares(at=[(60, 60)], contrast=120) + squares(at=[(100, 60), (60, 100), (100, 100)], contrast=14) - 100


def detect(grey: np.ndarray, **settings) -> orb.KeyPoints:
    return orb.detect(grey, ExtractConfig(**settings))


def near(points: orb.KeyPoints, u: int, v: int) -> int:
    """Count the key points on a square."""
    return int(((points.xy > [u - 4, v - 4]) & (points.xy < [u + 12, v + 12])).all(axis=1).sum())


@pytest.mark.shows("extract.features")
def test_features_is_how_many_key_points_are_wanted() -> None:
    few, many = (len(detect(tiles(), features=n)) for n in (100, 300))
    assert 90 <= few <= 100 < 250 <= many <= 300


@pytest.mark.shows("extract.levels")
def test_levels_are_those_of_the_pyramid() -> None:
    assert [int(detect(tiles(), levels=n).octave.max()) for n in (1, 4)] == [0, 3]


@pytest.mark.shows("extract.scale")
def test_scale_is_what_a_level_is_smaller_than_the_one_below() -> None:
    """Whole pixels of level 1 lie so many pixels apart in the picture."""
    for scale in (1.5, 2.0):
        points = detect(tiles(), scale=scale, levels=2, subpixel=False)
        x = np.unique(points.xy[points.octave == 1, 0].astype(np.float64))
        steps = (x - x[0]) / (320 / round(320 / scale))
        np.testing.assert_allclose(steps, np.rint(steps), atol=0.02)


@pytest.mark.shows("extract.cell")
def test_a_weak_corner_is_sought_in_cells_without_a_strong_one() -> None:
    fine, coarse = (detect(BOTH, cell=side, fast_threshold=40, weak=1.0) for side in (20, 200))
    assert near(fine, 60, 60) > 0 and near(fine, 100, 100) > 0
    assert near(coarse, 60, 60) > 0 and near(coarse, 100, 100) == 0


@pytest.mark.shows("extract.smooth")
def test_a_smoothed_copy_has_fewer_corners_of_noise() -> None:
    flat = tiles(contrast=0.0, noise=8.0)
    smooth, plain = (len(detect(flat, smooth=is_smooth)) for is_smooth in (True, False))
    assert smooth < 0.5 * plain


@pytest.mark.shows("extract.fast_threshold")
def test_beside_strong_corners_those_below_the_threshold_are_left_out() -> None:
    low, high = (detect(BOTH, fast_threshold=threshold, cell=200) for threshold in (6, 60))
    assert near(low, 100, 100) > 0 and near(high, 100, 100) == 0


@pytest.mark.shows("extract.fast_threshold_low")
def test_where_nothing_is_strong_a_lower_threshold_holds() -> None:
    assert [len(detect(WEAK, fast_threshold=60, fast_threshold_low=low)) > 0 for low in (4, 60)] == [True, False]


@pytest.mark.shows("extract.pool")
def test_a_small_pool_keeps_the_strongest_and_a_large_one_spreads() -> None:
    """Corners on the left are strong, those on the right weak."""
    grey = np.hstack([tiles(contrast=200.0)[:, :160], tiles(contrast=60.0)[:, 160:]])
    small, whole = (detect(grey, features=150, pool=pool, cell=10, weak=1.0) for pool in (1.0, 0.0))
    on_right = [(points.xy[:, 0] > 165).mean() for points in (small, whole)]
    assert np.median(small.response) > np.median(whole.response) and on_right[0] < on_right[1]


@pytest.mark.shows("extract.weak")
def test_weak_is_the_share_that_cells_without_a_strong_corner_may_give() -> None:
    grey = np.hstack([tiles(contrast=200.0)[:, :160], tiles(contrast=26.0)[:, 160:]])
    none, all_of_them = ((detect(grey, features=150, fast_threshold=30, weak=share).xy[:, 0] > 165).sum() for share in (0.0, 1.0))
    assert none == 0 < all_of_them


@pytest.mark.shows("extract.rank_by")
def test_key_points_are_ranked_by_what_is_chosen() -> None:
    """The score is a difference that nine neighbours all have, the response a sum over sixteen."""
    by_score, by_sum = (detect(tiles(), features=60, levels=1, pool=1.0, rank_by=how) for how in ("fast", "sum"))
    assert by_score.response.max() <= 255 < np.median(by_sum.response)


@pytest.mark.shows("extract.subpixel")
def test_without_subpixel_key_points_lie_on_whole_pixels() -> None:
    fine, whole = (detect(tiles(noise=3.0), levels=1, subpixel=is_fine).xy for is_fine in (True, False))
    assert (whole == np.rint(whole)).all() and (fine != np.rint(fine)).mean() > 0.5


class OneFrame:
    """A recording of one frame."""

    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)

    def __init__(self, depth: np.ndarray) -> None:
        self._depth = depth

    def __len__(self) -> int:
        return 1

    def grey(self, i: int) -> np.ndarray:
        return tiles()

    def depth(self, i: int) -> np.ndarray:
        return self._depth


@pytest.mark.shows("extract.depth_window")
def test_a_median_over_a_window_passes_over_single_bad_readings() -> None:
    depth = np.full((240, 320), 2.0, np.float32)
    depth[np.random.default_rng(0).random(depth.shape) < 0.08] = 3.0
    wrong = []
    for side in (1, 5):
        (frame,) = extract.frames(OneFrame(depth), ExtractConfig(depth_window=side, depth_jump=0.0), [0], workers=1)
        wrong.append((frame.depth > 2.5).mean())
    assert wrong[0] > 0.04 and wrong[1] == 0.0


class Tools:
    workers = 1

    def progress(self, items, label, total=None):
        return items


def matched(features: Features, out: Path, *, flow: Flow | None = None, **settings) -> tuple[Words, Matches]:
    out.mkdir()
    flow = flow or Flow()
    inputs = SimpleNamespace(load=lambda cls, stage: {Features: features, Flow: flow}[cls])
    match.run(inputs, out, SimpleNamespace(match=MatchConfig(**settings)), Tools())
    return artifacts.load(Words, out), artifacts.load(Matches, out)


def distances(features: Features, matches: Matches) -> np.ndarray:
    """Hamming distances of all matches."""
    of_match = np.repeat(np.arange(len(matches.pair)), np.diff(matches.offset))
    rows = np.asarray(features.offset)[np.asarray(matches.pair)[of_match]] + matches.row
    return np.unpackbits(features.desc[rows[:, 0]] ^ features.desc[rows[:, 1]], axis=1).sum(axis=1)


def seen(*, flipped_bits: int = 20, seed: int = 0) -> Features:
    rng = np.random.default_rng(seed)
    return observe(sweep(4, length=0.1), room_points(1500, rng), rng, flipped_bits=flipped_bits, per_frame=150).features


@pytest.mark.shows("match.node_level", "match.node_margin")
def test_fewer_features_share_a_node_farther_down_and_more_with_a_margin(tmp_path: Path) -> None:
    features = seen()
    near_root, far_down, margin = (
        len(matched(features, tmp_path / str(k), **settings)[1].row)
        for k, settings in enumerate((
            {"node_level": 1, "node_margin": -1}, {"node_level": 3, "node_margin": -1}, {"node_level": 1, "node_margin": 60},
        ))
    )  # fmt: skip
    assert far_down < near_root < margin


@pytest.mark.shows("match.max_distance")
def test_no_match_is_farther_apart_than_allowed(tmp_path: Path) -> None:
    features = seen()
    near_, far = (distances(features, matched(features, tmp_path / str(n), max_distance=n)[1]) for n in (30, 64))
    assert near_.max() <= 30 < far.max() <= 64 and 0 < len(near_) < len(far)


@pytest.mark.shows("match.ratio")
def test_a_strict_ratio_leaves_out_what_has_a_rival(tmp_path: Path) -> None:
    strict, loose = (len(matched(seen(), tmp_path / str(ratio), ratio=ratio)[1].row) for ratio in (0.2, 0.9))
    assert strict < 0.5 * loose


@pytest.mark.shows("match.check_rotation")
def test_matches_that_turn_another_way_than_most_are_left_out(tmp_path: Path) -> None:
    features = seen()
    features.angle[::3] = np.random.default_rng(1).uniform(-np.pi, np.pi, len(features.angle[::3]))
    checked, unchecked = (len(matched(features, tmp_path / str(check), check_rotation=check)[1].row) for check in (True, False))
    assert 0.2 * unchecked < checked < 0.8 * unchecked


@pytest.mark.shows("match.flow_radius")
def test_the_flow_may_end_so_far_from_its_partner(tmp_path: Path) -> None:
    """The flow of every key point of a frame ends 3 px beside one of the next; descriptors say nothing."""
    features = seen(flipped_bits=256)
    flow_xy = np.full_like(features.xy, np.nan)
    for frame in range(3):
        a, b, c = features.offset[frame : frame + 3]
        flow_xy[a : min(b, a + c - b)] = features.xy[b : b + min(b - a, c - b)] + [3.0, 0.0]
    found = [len(matched(features, tmp_path / str(r), flow=Flow(flow_xy=flow_xy), flow_radius=r)[1].row) for r in (0.5, 4.0)]
    assert found[0] < 0.2 * found[1]


@pytest.mark.shows("match.vocabulary")
def test_the_words_are_those_of_the_vocabulary_given(tmp_path: Path) -> None:
    features, rng = seen(), np.random.default_rng(0)
    own = kmeans.train([features.desc[:300], features.desc[300:]], branching=3, depth=2, rng=rng)
    vocabulary_file.write(tmp_path / "own.npz", own)
    words, _ = matched(features, tmp_path / "match", vocabulary=str(tmp_path / "own.npz"))
    assert words.word.max() < len(words.idf) == own.n_words <= 9
