"""What moves: somebody walks before a camera through the analytic room; the truth is what the walker hides."""

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from boxroom import FURNITURE, KINECT, look_along, render
from kinect import coded
from scipy import ndimage

from slamcli.config.options import SensorConfig
from slamcli.depth import icp
from slamcli.geometry import se3
from slamcli.schema import Features, Words
from slamcli.slam import background_motion_kernels, depth_views, moving_object_kernels, moving_objects
from slamcli.slam.background_motion import SWERVE_COST, SWERVE_MOST, SWERVE_MOST_LATER, BackgroundMotion, _steadiest, anchor_frames
from slamcli.slam.background_step import FLATNESS, SWERVE_M, Judgement, StepFinder
from slamcli.slam.depth_views import STEP, Views

FRAMES, RATE, SPEED = 36, 15.0, 0.6
WAIT, RESTING = 18, ("leaving", "waiting")  # frames that the waiter stands for; recordings of a camera at rest
WIDTH, NEAR, TALL = 0.55, 1.2, 1.3  # [m] of the walker, before the camera, and its height


def camera_at(i: int) -> np.ndarray:
    return look_along([1.2 + SPEED * i / RATE, 2.9 - 0.01 * i, 0.9], 0.02 * np.sin(i / 5), 0.15)


def walker(i: int) -> tuple:
    """A box that keeps before the camera, swaying from side to side."""
    x, y = 1.2 + SPEED * i / RATE + NEAR, 2.9 + 0.2 * np.sin(i / 6)
    return (x, y - WIDTH / 2, 0.0), (x + 0.3, y + WIDTH / 2, TALL)


def child(i: int) -> tuple:
    """Somebody small close before the camera, whose lower part no other view shows: a later one is past it, an earlier one sees less far down."""
    x = 1.2 + SPEED * i / RATE + 0.6
    return (x, 2.5 + 0.2 * np.sin(i / 6), 0.0), (x + 0.3, 3.3 + 0.2 * np.sin(i / 6), 0.7)


def waiter(i: int) -> tuple:
    """The same box, that stands and then goes aside at a walk, out of the view of a camera at rest."""
    (x, y, z), (x1, y1, z1) = walker(14)
    aside = 0.1 * max(0, i - WAIT)
    return (x, y + aside, z), (x1, y1 + aside, z1)


@cache
def recording(who: str) -> tuple[Views, np.ndarray]:
    """Views of the room with nobody, somebody who walks, or somebody who stands in it; and the places (F, v, u) that show somebody."""
    depth, masks = [], []
    for i in range(FRAMES):
        boxes = {
            "nobody": (), "walking": (walker(i),), "standing": (walker(12),), "leaving": (walker(14),) if i < 18 else (), "waiting": (waiter(i),),
            "close": (child(i),),
        }[who]  # fmt: skip
        T_lc = camera_at(0 if who in RESTING else i)
        seen, empty = render(T_lc, KINECT, boxes=(*FURNITURE, *boxes)), render(T_lc, KINECT)
        depth.append(icp.coarsen(seen))
        masks.append((seen < empty - 1e-3)[STEP // 2 :: STEP, STEP // 2 :: STEP])
    T_wc = np.array([camera_at(0 if who in RESTING else i) for i in range(FRAMES)])
    return Views(coded(depth), np.arange(FRAMES) / RATE, T_wc, np.zeros(FRAMES, dtype=np.int64), KINECT), np.array(masks)


def test_a_walker_is_found_and_next_to_nothing_else() -> None:
    views, truth = recording("walking")
    assert moving_objects.is_any(views)
    found = moving_objects.find(views)
    recall = np.array([(a & b).sum() / b.sum() for a, b in zip(found, truth, strict=True)])
    false = np.array([(a & ~b).sum() / (~b).sum() for a, b in zip(found, truth, strict=True)])
    assert truth.mean() > 0.2
    assert np.median(recall) > 0.9 and recall.min() > 0.5
    assert np.median(false) < 0.02 and false.max() < 0.25


@pytest.mark.parametrize("who", ["nobody", "standing"])
def test_what_stands_still_while_it_is_seen_is_kept(who: str) -> None:
    views, _ = recording(who)
    assert not moving_objects.is_any(views) and not moving_objects.find(views).any()


@pytest.mark.parametrize(("frames", "moves"), [((8,), False), ((8, 28), False), ((8, 12), True)])
def test_single_frames_that_seem_to_show_motion_far_apart_are_none(frames: tuple[int, ...], moves: bool) -> None:
    views, _ = recording("nobody")
    T_wc = views.T_wc.copy()
    T_wc[list(frames), 2, 3] += 0.25  # a pose that is wrong makes everything in its view seem to have moved
    assert moving_objects.is_any(replace(views, T_wc=T_wc)) == moves


def test_who_stood_half_the_time_is_kept_for_poses_and_not_for_maps() -> None:
    views, truth = recording("leaving")
    views = replace(views, stamp=6.0 * views.stamp)  # leaves after seven of fourteen seconds
    for rule, least, most in ((moving_objects.FOR_POSES, 0.0, 0.0), (moving_objects.FOR_MAPS, 0.9, 1.0)):
        found = moving_objects.find(views, rule=rule)
        assert least <= (found & truth)[8:12].sum() / truth[8:12].sum() <= most
        assert (found & ~truth).sum() / (~truth).sum() < 0.03


def test_maps_leave_out_what_hangs_together_with_somebody_and_no_other_view_shows() -> None:
    views, truth = recording("close")
    least = {}
    for spreads in (False, True):
        found = moving_objects.find(views, rule=replace(moving_objects.FOR_MAPS, min_through=2, spreads=spreads))
        least[spreads] = min((a & b).sum() / b.sum() for a, b in zip(found, truth, strict=True))
        assert (found & ~truth).sum() < 0.01 * (~truth).sum()
    assert least[False] < 0.9 and least[True] > 0.98


@pytest.mark.parametrize("others_known", [True, False])
def test_what_is_found_again_only_where_it_moves_is_not_confirmed(others_known: bool) -> None:
    views, truth = recording("waiting")
    frame = 5
    legs = truth[frame] & (np.arange(truth.shape[1])[:, None] > np.flatnonzero(truth[frame].any(axis=1)).mean())
    moving = truth & ~(legs & ~(others_known & (np.arange(FRAMES) != frame)[:, None, None]))
    found = moving_objects.spread(views, moving, moving_objects.FOR_MAPS.after)[frame]
    assert legs.sum() > 100 and (found & legs).mean() / legs.mean() == pytest.approx(1.0 if others_known else 0.0, abs=0.15)
    assert (found & ~truth[frame]).sum() < 0.01 * (~truth[frame]).sum()


def test_who_waits_and_then_walks_on_is_found_while_waiting_and_the_floor_is_not() -> None:
    views, truth = recording("waiting")
    found = moving_objects.find(views)
    recall = np.array([(a & b).sum() / b.sum() for a, b in zip(found[: WAIT + 4], truth[: WAIT + 4], strict=True)])
    assert recall.min() > 0.75 and np.median(recall) > 0.9
    assert (found & ~truth).sum() / (~truth).sum() < 0.02
    kept = moving_objects.find(views, rule=replace(moving_objects.FOR_POSES, followed=0.0))
    assert (kept & truth)[2 : WAIT - 6].sum() < 0.5 * (found & truth)[2 : WAIT - 6].sum()  # that is what following adds


def test_nothing_is_said_under_unknown_or_wholly_wrong_poses() -> None:
    views, _ = recording("walking")
    lost = replace(views, T_wc=np.full_like(views.T_wc, np.nan))
    assert not moving_objects.find(lost).any()
    apart = replace(views, world=np.arange(FRAMES))
    assert not moving_objects.find(apart).any()
    # Believed to rest, the camera sees the walker rest and the room come nearer: most of the room seems to move, which cannot be.
    still = replace(views, T_wc=np.tile(np.eye(4), (FRAMES, 1, 1)))
    _, truth = recording("walking")
    assert (moving_objects.find(still) & ~truth).mean() < 0.6


def test_hiding_takes_away_what_is_marked_and_no_more() -> None:
    views, _ = recording("walking")
    rows, columns = depth_views.shape(KINECT)
    moving = np.zeros((FRAMES, rows, columns), dtype=bool)
    moving[3, 20:30, 30:40] = True
    xy = np.array([[70.0, 50.0], [10.0, 10.0], [70.0, 50.0]], dtype=np.float32)  # the first is in the middle of what moves
    offset = np.zeros(FRAMES + 1, dtype=np.int64)
    offset[4:], offset[5:] = 2, 3
    features = Features(
        stamp=views.stamp, depth_stamp=views.stamp, offset=offset, xy=xy, depth=np.ones(3, np.float32), slope=np.zeros((3, 2), np.float32),
        octave=np.zeros(3, np.uint8), angle=np.zeros(3, np.float32), desc=np.zeros((3, 32), np.uint8), octave_scale=np.float64(1.2),
    )  # fmt: skip
    hidden = moving_objects.hide_features(features, moving, KINECT)
    assert np.isnan(hidden.depth).tolist() == [True, False, False] and (hidden.xy[0] < -1000).all()
    np.testing.assert_array_equal(hidden.xy[1:], xy[1:])
    coarse = moving_objects.hide_coarse(views.depth, moving, KINECT).of(range(FRAMES))
    changed = coarse != views.depth.of(range(FRAMES))
    assert (coarse[3, 42:58, 62:78] == 0).all() and changed[3].sum() <= 24 * 24 and not changed[:3].any() and not changed[4:].any()
    pixels = moving_objects.hide_pixels(np.ones((120, 160), np.float32), moving[3], KINECT)
    assert np.isnan(pixels[42:58, 62:78]).all() and np.isfinite(pixels[:36]).all()
    assert moving_objects.hide_features(features, np.zeros((0, 0, 0), bool), KINECT) is features


def without_texture(views: Views) -> tuple[Features, Words]:
    empty = {"xy": (0, 2), "depth": (0,), "slope": (0, 2), "octave": (0,), "angle": (0,), "desc": (0, 32)}
    kinds = {"octave": np.uint8, "desc": np.uint8}
    features = Features(
        stamp=views.stamp, depth_stamp=views.stamp, offset=np.zeros(FRAMES + 1, np.int64), octave_scale=np.float64(1.2),
        **{name: np.zeros(size, kinds.get(name, np.float32)) for name, size in empty.items()},
    )  # fmt: skip
    return features, Words(
        np.ones(1, np.float32), np.zeros(FRAMES + 1, np.int64), np.zeros(0, np.int32), np.zeros(1, np.int32), np.zeros(0, np.int32)
    )


def test_the_motion_of_the_room_is_found_where_somebody_walks_along() -> None:
    """Depth alone, no feature at all: half of the view keeps its place before the camera."""
    views, truth = recording("walking")
    assert truth.mean() > 0.2
    features, words = without_texture(views)

    def poses() -> np.ndarray:
        return BackgroundMotion(features, words, views.depth, KINECT, SensorConfig(), np.random.default_rng(0)).poses()

    found = poses()
    np.testing.assert_array_equal(found, poses())
    true = se3.inverse(views.T_wc[0]) @ views.T_wc
    error = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
    assert np.linalg.norm(true[-1, :3, 3]) > 1.3 and error.max() < 0.08


@pytest.mark.parametrize("share", [0.2, 0.9])
def test_a_first_step_that_explains_little_is_judged_by_what_follows_it(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    views, _ = recording("walking")
    candidates = StepFinder.candidates

    def with_the_walker_at_first(finder: StepFinder, reference: int, i: int, *others: list[np.ndarray]) -> list[Judgement]:
        if reference > 0:
            return candidates(finder, reference, i, *others)
        return [Judgement(np.eye(4), score=share, explained=share, contradicted=0.0, agrees=np.zeros(0, dtype=bool))]

    monkeypatch.setattr(StepFinder, "candidates", with_the_walker_at_first)
    found = BackgroundMotion(*without_texture(views), views.depth, KINECT, SensorConfig(), np.random.default_rng(0)).poses()
    true = se3.inverse(views.T_wc[0]) @ views.T_wc
    first = anchor_frames(views.stamp, np.ones(FRAMES, dtype=bool))[1]
    error = np.linalg.norm(found[first, :3, 3] - true[first, :3, 3])
    assert error < 0.03 if share < 0.4 else error > 0.15  # what explains most of the view stays as it was found


def test_the_room_speaks_for_its_own_motion_by_its_extent() -> None:
    views, _ = recording("walking")
    source, target = (icp.surface_points(views.depth[i], KINECT, SensorConfig()) for i in (10, 16))
    true, followed = se3.inverse(views.T_wc[16]) @ views.T_wc[10], np.eye(4)

    def explain(T: np.ndarray) -> tuple[float, float]:
        return background_motion_kernels.explain(np.ascontiguousarray(T), source.points, target.points, target.view, FLATNESS)

    surface = background_motion_kernels.surface(source.xyz, source.normal, source.pinhole)
    (right, against_right), (wrong, against_wrong) = explain(true), explain(followed)
    assert right - against_right > 2 * max(wrong - against_wrong, 0.0) and right < surface and against_wrong > against_right


def test_votes_are_counted_as_by_hand() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform([-1, -1, 1], [1, 1, 4], (60, 3))
    T = np.array([np.eye(4), se3.exp(np.array([0.1, 0.0, 0.05, 0.0, 0.02, 0.0]))])
    moved = se3.transform(T[1], x)
    moved[:20] = x[:20]
    pinhole = np.array([150.0, 150.0, 80.0, 60.0])
    xy = moved[:, :2] / moved[:, 2:] * pinhole[:2] + pinhole[2:] + rng.normal(0, 0.5, (60, 2))
    depth, weight = moved[:, 2] + rng.normal(0, 0.01, 60), rng.uniform(0.5, 2.0, 60)
    depth[::7] = np.nan
    agrees = np.zeros(60, dtype=np.bool_)
    matches = background_motion_kernels.WeightedMatches(x, np.ascontiguousarray(xy), depth, np.full(60, 1.0), np.full(60, 50.0), weight)
    best, total = background_motion_kernels.vote(T, matches, pinhole, 9.0, agrees)
    expected, shares = [], []
    for pose in T:
        y = se3.transform(pose, x)
        e = ((y[:, :2] / y[:, 2:] * pinhole[:2] + pinhole[2:] - xy) ** 2).sum(axis=1)
        e += np.nan_to_num((y[:, 2] - depth) * 50.0) ** 2
        expected.append(e < 9.0)
        shares.append(np.maximum(0.0, 1.0 - e / 9.0))
    sums = [(weight * one).sum() for one in shares]
    assert best == np.argmax(sums) == 1 and total == pytest.approx(max(sums))
    np.testing.assert_array_equal(agrees, expected[1])


@pytest.mark.parametrize("seed", range(4))
def test_groups_and_regions_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seed_places, flat = rng.random((40, 50)) < 0.35, np.ones((40, 50), np.float32)
    label, n = ndimage.label(seed_places, structure=np.ones((3, 3)))
    size = ndimage.sum_labels(seed_places, label, np.arange(n + 1))
    np.testing.assert_array_equal(moving_object_kernels.groups(seed_places, flat, 0.1, 12), seed_places & (size >= 12)[label])
    start = np.zeros_like(seed_places)
    start[20:23, 20:23] = True
    for most in (1, 3, 100):
        grown = ndimage.binary_dilation(start, structure=np.ones((3, 3)), iterations=most, mask=seed_places | start)
        np.testing.assert_array_equal(moving_object_kernels.grow(start, seed_places, flat, 0.1, most), grown)


def test_a_region_stops_where_depth_jumps() -> None:
    z = np.ones((10, 20), np.float32)
    z[:, 12:] = 1.5
    start, everywhere = np.zeros((10, 20), bool), np.ones((10, 20), bool)
    start[5, 2] = True
    grown = moving_object_kernels.grow(start, everywhere, z, 0.1, 100)
    assert grown[:, :12].all() and not grown[:, 12:].any()


@pytest.mark.parametrize(("seen", "said"), [(1.0, "AGAIN"), (1.6, "THROUGH"), (0.6, "HIDDEN"), (0.0, "UNKNOWN"), (1.05, "AGAIN")])
def test_what_another_view_says_of_a_wall(seen: float, said: str) -> None:
    z = np.ones((12, 16), np.float32)
    images = np.full((1, 12, 16), round(seen / icp.UNIT), np.uint16)
    place = np.arange(12 * 16, dtype=np.int32).reshape(12, 16)
    out = np.zeros((1, 6, 8), np.uint8)
    smooth = moving_object_kernels.smooth_places(z, 0.06)
    assert smooth[1:-1, 1:-1].all() and not smooth[0].any()
    others = moving_object_kernels.Others(images, place, np.eye(4)[None], icp.UNIT)
    moving_object_kernels.compare(z, smooth, 2, others, np.array([15.0, 15.0, 7.5, 5.5]), np.array([0.06, 0.02, 0.008]), out)
    assert set(np.unique(out[0, :-1, :-1])) == {getattr(moving_object_kernels, said)}


def test_anchors_are_apart_and_hold_both_ends() -> None:
    stamp = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.2, 80))
    anchors = np.array(anchor_frames(stamp, np.ones(80, bool)))
    assert anchors[0] == 0 and anchors[-1] == 79 and (np.diff(anchors) > 0).all()
    assert (np.diff(stamp[anchors])[:-1] >= 0.35 - 1e-6).all() and np.diff(stamp[anchors]).max() < 0.35 + 0.2
    assert anchor_frames(stamp[:1], np.ones(1, bool)) == [0]


def test_anchors_show_depth_but_for_the_ends() -> None:
    shows = np.random.default_rng(3).random(200) < 0.5
    shows[190:] = False
    anchors = anchor_frames(np.arange(200) / 30.0, shows)
    assert shows[anchors[1:-1]].all() and (anchors[0], anchors[-1]) == (0, 199) and np.diff(anchors).max() < 20


def judged(scores: list[float], forward: list[float]) -> list[Judgement]:
    """Candidates of one step, which go so far forward."""
    pairs = zip(scores, forward, strict=True)
    return [Judgement(se3.exp(np.array([0.0, 0.0, z, 0.0, 0.0, 0.0])), score, score, 0.0, np.zeros(0, bool)) for score, z in pairs]


def test_one_wrong_step_does_not_lead_those_after_it_astray() -> None:
    """Somebody walks along: at one step the camera's rest is believed a little more, and of every later one the same is expected."""
    steps = [judged([0.6, 0.5], [0.2, 0.0]), judged([0.48, 0.5], [0.2, 0.0]), *(judged([0.6, 0.58], [0.2, 0.0]) for _ in range(4))]
    chosen = _steadiest(steps, [1.0] * len(steps), most=SWERVE_MOST)
    np.testing.assert_allclose([T[2, 3] for T in chosen], 0.2, atol=1e-12)


def test_a_turn_that_ends_by_and_by_is_not_taken_for_one_cut_short() -> None:
    """What the step after it shows explains less of a step, but makes of two swerves one; what moves is left out by then."""
    steps = [judged([0.6], [0.40]), judged([0.6], [0.40]), judged([0.6, 0.4], [0.27, 0.14]), judged([0.6], [0.14]), judged([0.6], [0.14])]
    assert _steadiest(steps, [1.0] * len(steps), most=SWERVE_MOST_LATER)[2][2, 3] == pytest.approx(0.27)


@pytest.mark.parametrize("seed", range(3))
def test_the_steadiest_motions_are_those_of_all_combinations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps, scale = (
        [judged(rng.uniform(0.2, 0.7, 3).tolist(), rng.uniform(-0.2, 0.2, 3).tolist()) for _ in range(5)],
        rng.uniform(0.8, 1.2, 5),
    )

    def worth(numbers: tuple[int, ...]) -> float:
        chosen = [one[number] for one, number in zip(steps, numbers, strict=True)]
        pairs = zip(chosen[:-1], chosen[1:], scale[1:], strict=True)
        change = [min(((b.T[2, 3] - share * a.T[2, 3]) / SWERVE_M) ** 2, SWERVE_MOST) for a, b, share in pairs]
        return sum(one.score for one in chosen) - SWERVE_COST * sum(change)

    best = max(product(range(3), repeat=5), key=worth)
    found = _steadiest(steps, scale.tolist(), most=SWERVE_MOST)
    np.testing.assert_allclose([T[2, 3] for T in found], [one[number].T[2, 3] for one, number in zip(steps, best, strict=True)], atol=1e-12)
