from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scenes import CAMERA, observe, room_points, sweep

from slamcli.calibration import rolling_shutter
from slamcli.calibration.rolling_shutter import depth_poses
from slamcli.geometry import se3
from slamcli.schema import Features, Timing

RATE = np.array([0.3, -0.2, 0.1, 0.2, 0.4, -0.1])  # twist a second


def moving(stamp: np.ndarray) -> np.ndarray:
    return se3.exp(np.multiply.outer(stamp, RATE))


def test_a_steady_motion_is_followed_to_the_depth_images_time() -> None:
    stamp = np.arange(10) / 30.0
    depth_stamp = stamp + np.array([0.01, -0.01, 0.0, 0.016, -0.016, 0.004, -0.004, 0.01, -0.01, -0.01])
    np.testing.assert_allclose(depth_poses(stamp, depth_stamp, moving(stamp)), moving(depth_stamp), atol=1e-9)


def test_poses_stay_where_there_is_no_depth_no_neighbour_or_a_long_gap() -> None:
    stamp = np.array([0.0, 0.03, 0.06, 1.0, 1.03, 1.06])
    depth_stamp = np.array([-0.01, np.nan, 0.07, 0.99, 1.04, 1.07])
    T_wc = moving(stamp)
    T_wc[5] = np.nan
    out = depth_poses(stamp, depth_stamp, T_wc)
    np.testing.assert_array_equal(out, T_wc)  # before the first, none, across the gap (twice), towards a lost frame, lost


def test_the_poses_given_are_not_changed() -> None:
    stamp = np.array([0.0, 0.03])
    T_wc = moving(stamp)
    before = T_wc.copy()
    assert not np.array_equal(depth_poses(stamp, stamp + 0.01, T_wc), before)
    np.testing.assert_array_equal(T_wc, before)


def seen_of_a_plane(when: Timing, normal: np.ndarray, rng: np.random.Generator) -> tuple[Features, np.ndarray, np.ndarray]:
    """Let a steadily moving camera with rolling shutters see the plane normal . x = 1; features, and where their points are at the stamp.

    Positions are those of the camera's frame at the colour stamp, 0.
    """
    n = 400
    raw = rng.uniform([20, 20], [620, 460], (n, 2))
    ray = CAMERA.backproject(raw, np.ones(n))
    share = raw[:, 1] / CAMERA.height - 0.5

    def hit(seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the depth in the camera of that time and the point in that of the stamp."""
        T = se3.exp(seconds[:, None] * when.twist[0])
        towards = np.einsum("nij,nj->ni", T[:, :3, :3], ray)
        z = (1.0 - T[:, :3, 3] @ normal) / (towards @ normal)
        return z, T[:, :3, 3] + z[:, None] * towards

    _, x = hit(share * float(when.readout))
    depth_stamp = 0.008
    depth, _ = hit(depth_stamp + float(when.depth_delay) + share * float(when.depth_readout))
    # n . ray z = 1 on the plane of the camera's own time: its slope, which a depth image shows as it is then.
    now = se3.exp(np.asarray(when.twist[0]) * (depth_stamp + float(when.depth_delay)))
    seen = normal @ now[:3, :3] / (1.0 - normal @ now[:3, 3])
    slope = np.tile(seen[:2] / [CAMERA.fx, CAMERA.fy], (n, 1))
    stamp = np.zeros(1)
    features = Features(
        stamp, stamp + depth_stamp, np.array([0, n]), raw.astype("f4"), depth.astype("f4"), slope.astype("f4"),
        *(np.zeros(n, t) for t in ("u1", "f4")), np.zeros((n, 32), np.uint8), np.array(1.2),
    )  # fmt: skip
    return features, CAMERA.project(x), x[:, 2]


@pytest.mark.parametrize("twist", [[0.0, 0.0, 0.0, 0.6, -0.4, 0.3], [0.3, -0.2, 0.4, 0.0, 0.0, 0.0], [0.2, 0.1, -0.3, -0.5, 0.7, 0.2]])
@pytest.mark.parametrize("normal", [[0.0, 0.0, 0.5], [0.3, -0.4, 0.35]])
def test_what_rolling_shutters_saw_of_a_plane_is_rectified_to_where_it_was_at_the_stamp(twist, normal):
    when = Timing(np.array(0.02), np.array(0.025), np.array(-0.02), np.array([twist]))
    features, xy, z = seen_of_a_plane(when, np.array(normal), np.random.default_rng(0))
    good = (z > 0.5) & (z < 8.0)
    assert good.sum() > 200
    rectified = rolling_shutter.rectify(features, when, CAMERA)

    def rms(found: Features) -> tuple[float, float]:
        return float(np.sqrt(np.mean((found.xy - xy)[good] ** 2))), float(np.sqrt(np.mean((found.depth / z - 1.0)[good] ** 2)))

    px, share = rms(rectified)
    px_before, share_before = rms(features)
    assert px < 0.05 * px_before + 0.01 and share < 0.1 * share_before + 1e-4
    if any(normal[:2]) and any(twist[3:]):
        _, without_slant = rms(rolling_shutter.rectify(replace(features, slope=0 * features.slope), when, CAMERA))
        assert without_slant > 5.0 * share


def test_the_motion_is_that_of_a_cubic_and_of_a_line_where_a_frame_is_missing():
    stamp = np.arange(9) / 30.0 + np.array([0, 1, 0, -1, 2, 0, 1, 0, 0]) * 1e-3
    path = np.zeros((9, 4, 4)) + np.eye(4)
    path[:, 0, 3] = 0.3 * stamp - 2.0 * stamp**2 + 20.0 * stamp**3
    speed = rolling_shutter.twists(stamp, path)[:, 0]
    np.testing.assert_allclose(speed[2:-2], (0.3 - 4.0 * stamp + 60.0 * stamp**2)[2:-2], rtol=1e-6)
    np.testing.assert_allclose(
        speed[[0, -1]], [np.polyfit(s, path[i, 0, 3], 1)[0] for i, s in ((slice(3), stamp[:3]), (slice(-3, None), stamp[-3:]))]
    )
    path[4] = np.nan
    line = [2, 3, 5]
    twist = rolling_shutter.twists(stamp, path)
    np.testing.assert_allclose(twist[3, 0], np.polyfit(stamp[[1, *line]], path[[1, *line], 0, 3], 1)[0])
    np.testing.assert_array_equal(twist[4], np.zeros(6))
    np.testing.assert_array_equal(rolling_shutter.twists(stamp[:1], path[:1]), np.zeros((1, 6)))


@pytest.mark.parametrize("delay", [0.01, np.nan])
def test_features_are_rectified_by_what_flow_says_of_them(delay):
    rng = np.random.default_rng(0)
    scene = observe(sweep(6), room_points(2000, rng), rng)
    given = replace(
        scene.features,
        slope=rng.normal(0, 1e-3, scene.features.slope.shape).astype(np.float32),
        depth=np.where(rng.random(len(scene.features.depth)) < 0.2, np.float32(np.nan), scene.features.depth),
    )
    when = Timing(readout=np.array(0.02), depth_readout=np.array(0.03), depth_delay=np.array(delay), twist=rng.normal(0, 0.5, (6, 6)))
    found = rolling_shutter.rectify(given, when, CAMERA)
    rows = np.arange(len(given.xy))
    moving = rolling_shutter.flow(given, when.twist, CAMERA, rows)
    later = moving.share * 0.02
    expected = (given.xy - moving.px_per_s * later[:, None]).astype(np.float32)
    assert np.abs(expected - given.xy).max() > 1.0
    np.testing.assert_array_equal(found.xy, expected)
    if np.isnan(delay):
        np.testing.assert_array_equal(found.depth, given.depth)
        return
    lag = rolling_shutter.depth_lag(given, when)[np.searchsorted(given.offset, rows, side="right") - 1]
    z = given.depth - moving.reading_per_s * (lag + moving.share * 0.03) - moving.slant_per_s * later
    assert np.nanmax(np.abs(z - given.depth)) > 0.005
    np.testing.assert_array_equal(found.depth, np.where(z > 0, z, np.nan).astype(np.float32))


def test_depth_is_moved_to_where_colour_was_taken():
    stamp = np.arange(5) / 30.0
    twist = np.tile([0.3, 0.0, 0.1, 0.0, 0.5, 0.0], (5, 1))
    features = SimpleNamespace(stamp=stamp, depth_stamp=np.append(stamp[:4] + 0.01, np.nan))
    when = Timing(readout=np.array(0.0), depth_readout=np.array(0.0), depth_delay=np.array(-0.03), twist=twist)
    T_cd = rolling_shutter.depth_to_colour(features, when, np.array([1, 4]))
    np.testing.assert_allclose(T_cd[0], se3.exp(-0.02 * twist[0]), atol=1e-12)
    np.testing.assert_allclose(T_cd[1], np.eye(4), atol=1e-12)
