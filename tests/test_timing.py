from types import SimpleNamespace

import numpy as np
from scenes import CAMERA, observe, room_points, sweep

from slamcli.geometry import se3
from slamcli.mapping import timing
from slamcli.mapping.timing import depth_poses
from slamcli.schema import Timing

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


def test_features_are_rectified_the_same_in_small_portions(monkeypatch):
    rng = np.random.default_rng(0)
    scene = observe(sweep(6), room_points(2000, rng), rng)
    when = timing.Timing(readout=np.array(0.02), depth_delay=np.array(0.01), twist=rng.normal(0, 0.5, (6, 6)))
    whole = timing.rectify(scene.features, when, CAMERA)
    assert np.abs(whole.xy - scene.features.xy).max() > 1.0 and np.nanmax(np.abs(whole.depth - scene.features.depth)) > 0.005
    monkeypatch.setattr(timing, "ROWS_AT_ONCE", 100)
    again = timing.rectify(scene.features, when, CAMERA)
    np.testing.assert_array_equal(again.xy, whole.xy)
    np.testing.assert_array_equal(again.depth, whole.depth)


def test_depth_is_moved_to_where_colour_was_taken():
    stamp = np.arange(5) / 30.0
    twist = np.tile([0.3, 0.0, 0.1, 0.0, 0.5, 0.0], (5, 1))
    features = SimpleNamespace(stamp=stamp, depth_stamp=np.append(stamp[:4] + 0.01, np.nan))
    when = Timing(readout=np.array(0.0), depth_delay=np.array(-0.03), twist=twist)
    T_cd = timing.depth_to_colour(features, when, np.array([1, 4]))
    np.testing.assert_allclose(T_cd[0], se3.exp(-0.02 * twist[0]), atol=1e-12)
    np.testing.assert_allclose(T_cd[1], np.eye(4), atol=1e-12)
