"""The key-frame rule, clause by clause."""

from dataclasses import replace

import numpy as np
import pytest

from slamcli.config.options import TrackConfig
from slamcli.geometry import se3
from slamcli.slam.key_frames import (
    FEW_NEAR_LANDMARKS,
    HAS_MOVED,
    LEAVES_REFERENCE,
    MANY_NEAR_FEATURES,
    NEW_SURFACE,
    OVERDUE,
    DepthSighting,
    Sighting,
    by_depth,
    by_landmarks,
    count_crowd,
)

SETTINGS = TrackConfig(min_inliers=15, key_frame_share=0.75, key_frame_gap=30, key_frame_crowd=4)
CALM = Sighting(n_landmarks=400, n_near_landmarks=300, n_near_new=200, n_reference=420, frames_since=3, n_crowd=0)  # nothing asks for one


def test_a_frame_that_sees_its_reference_well_is_none():
    assert not by_landmarks(CALM, SETTINGS)


@pytest.mark.shows("track.key_frame_share")
@pytest.mark.parametrize(("n_landmarks", "expected"), [(315, False), (314, True)])  # three quarters of 420
def test_leaving_the_reference_asks_for_one_exactly_below_its_share(n_landmarks: int, expected: bool):
    assert by_landmarks(replace(CALM, n_landmarks=n_landmarks), replace(SETTINGS, key_frame_share=0.75)) == (
        LEAVES_REFERENCE if expected else ""
    )


@pytest.mark.shows("track.key_frame_gap")
@pytest.mark.parametrize(("frames_since", "expected"), [(29, False), (30, True)])
def test_a_long_time_asks_for_one(frames_since: int, expected: bool):
    assert by_landmarks(replace(CALM, frames_since=frames_since), replace(SETTINGS, key_frame_gap=30)) == (OVERDUE if expected else "")


@pytest.mark.shows("track.key_frame_crowd")
@pytest.mark.parametrize("asks", [{"n_landmarks": 100}, {"frames_since": 99}])
def test_where_enough_stand_already_neither_counts(asks: dict):
    crowd_of_four = replace(SETTINGS, key_frame_crowd=4)
    assert by_landmarks(replace(CALM, n_crowd=3, **asks), crowd_of_four)
    assert not by_landmarks(replace(CALM, n_crowd=4, **asks), crowd_of_four)


@pytest.mark.parametrize("n_crowd", [0, 99])
def test_much_new_surface_asks_for_one_whoever_stands_there(n_crowd: int):
    new = replace(CALM, n_near_landmarks=FEW_NEAR_LANDMARKS - 1, n_near_new=MANY_NEAR_FEATURES + 1, n_crowd=n_crowd)
    assert by_landmarks(new, SETTINGS) == NEW_SURFACE
    assert not by_landmarks(replace(new, n_near_landmarks=FEW_NEAR_LANDMARKS), SETTINGS)
    for few in (MANY_NEAR_FEATURES, MANY_NEAR_FEATURES // 2):
        assert not by_landmarks(replace(new, n_near_new=few), SETTINGS)


def test_without_depth_there_is_nothing_to_make_landmarks_of():
    blind = replace(CALM, n_landmarks=10, frames_since=99, n_near_landmarks=4, n_near_new=10)
    assert not by_landmarks(blind, SETTINGS)
    assert by_landmarks(replace(blind, n_near_new=11), SETTINGS)


@pytest.mark.parametrize(
    ("twist", "overlap", "expected"),
    [
        ([0, 0, 0.28, 0, np.radians(14.0), 0], 0.8, ""),
        ([0, 0, 0.32, 0, 0, 0], 0.8, HAS_MOVED),
        ([0.2, 0.2, 0.2, 0, 0, 0], 0.8, HAS_MOVED),  # 0.35 m
        ([0, 0, 0, 0, np.radians(16.0), 0], 0.8, HAS_MOVED),
        ([0, 0, 0, np.radians(16.0), 0, 0], 0.8, HAS_MOVED),
        ([0, 0, 0, 0, 0, np.radians(16.0)], 0.8, HAS_MOVED),
        ([0, 0, 0, 0, 0, 0], 0.75, ""),
        ([0, 0, 0, 0, 0, 0], 0.74, LEAVES_REFERENCE),
    ],
)
def test_on_depth_the_way_from_the_reference_and_what_is_left_of_it_decide(twist: list, overlap: float, expected: str):
    seen = DepthSighting(se3.exp(np.array(twist, dtype=float)), overlap, is_anchored=True)
    assert by_depth(seen, SETTINGS) == expected
    assert not by_depth(replace(seen, is_anchored=False), SETTINGS), "what rests on it would share the error that was lent to it"


def test_a_crowd_stands_near_and_looks_the_same_way():
    T = np.tile(np.eye(4), (5, 1, 1))
    T[1, :3, 3] = [0.09, 0, 0]
    T[2, :3, 3] = [0.08, 0, 0.08]  # 0.11 m
    T[3] = se3.exp(np.array([0, 0, 0, 0, np.radians(5.5), 0]))
    T[4] = se3.exp(np.array([0, 0, 0, 0, np.radians(6.5), 0]))
    assert count_crowd(T, np.eye(4)) == 3
    assert count_crowd(T[:0], np.eye(4)) == 0
