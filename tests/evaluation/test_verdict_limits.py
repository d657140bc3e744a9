"""A map's verdict at the limits of what is measured: each reason appears just beyond its own, and only what is grave spoils the map."""

from dataclasses import replace

import pytest

from slamcli.evaluation import map_verdict
from slamcli.evaluation.map_evidence import MapEvidence
from slamcli.evaluation.map_verdict import DOUBLED, HOLES, NO_FLOOR, OFF_PATH, RARE_FLOOR, SMALL, TOO_HIGH, WALL

SOUND = MapEvidence(
    free_area=20.0, path_area=6.0, path_known=0.9, is_floor_found=True, views=100, views_with_floor=90, views_of_a_wall=0, missing=0.1,
    views_doubled=0, doubled_by=float("nan"), camera_height=1.0, camera_pitch_deg=20.0,
)  # fmt: skip


def judged(**change) -> tuple[list[str], bool]:
    """Return the causes named for a sound map but for a change, and whether a robot could use it."""
    verdict = map_verdict.judge(replace(SOUND, **change), max_range=4.0)
    assert verdict.is_usable == (not any(finding.is_grave for finding in verdict.findings))
    return [finding.cause for finding in verdict.findings], verdict.is_usable


@pytest.mark.parametrize(
    ("change", "causes", "is_usable"),
    [
        ({}, [], True),
        ({"free_area": 2.0, "path_area": 1.0}, [], True),
        ({"free_area": 1.99, "path_area": 1.0}, [SMALL], False),
        ({"free_area": 6.0}, [], True),  # as much as the camera passed over
        ({"free_area": 5.99}, [SMALL], False),
        ({"views_with_floor": 40}, [], True),
        ({"views_with_floor": 39}, [RARE_FLOOR], False),
        ({"views_with_floor": 39, "camera_height": 1.29}, [RARE_FLOOR], False),
        ({"views_with_floor": 39, "camera_height": 1.3}, [TOO_HIGH], False),
        ({"views_with_floor": 0}, [NO_FLOOR], False),
        ({"views_with_floor": 0, "camera_height": 1.3}, [TOO_HIGH], False),
        ({"is_floor_found": False}, [NO_FLOOR], False),
        ({"is_floor_found": False, "camera_height": 2.0}, [NO_FLOOR], False),  # a height above what is no floor
        ({"views_doubled": 4}, [], True),
        ({"views_doubled": 5, "doubled_by": 0.2}, [DOUBLED], False),
        ({"path_known": 0.25}, [], True),
        ({"path_known": 0.24}, [OFF_PATH], True),
        ({"missing": 0.4}, [], True),
        ({"missing": 0.41}, [HOLES], True),
        ({"views_of_a_wall": 99}, [], True),  # a wall spoils nothing by itself
        ({"free_area": 1.0, "views_of_a_wall": 40}, [SMALL], False),
        ({"free_area": 1.0, "views_of_a_wall": 41}, [WALL], False),
        ({"free_area": 1.0, "missing": 0.41}, [HOLES], False),
        ({"free_area": 1.0, "path_known": 0.0}, [SMALL], False),
    ],
)
def test_each_reason_begins_at_its_own_limit(change: dict, causes: list[str], is_usable: bool) -> None:
    assert judged(**change) == (causes, is_usable)


def test_the_most_telling_reason_comes_first() -> None:
    everything = {"views_doubled": 50, "doubled_by": 0.2, "views_of_a_wall": 60, "missing": 0.6, "views_with_floor": 10, "path_known": 0.1}
    assert judged(**everything) == ([DOUBLED, WALL, HOLES, RARE_FLOOR], False)
    assert judged(missing=0.6, path_known=0.1) == ([HOLES, OFF_PATH], True)


@pytest.mark.parametrize(("height", "max_range", "degrees"), [(1.5, 4.0, 30), (3.0, 4.0, 90), (5.0, 4.0, 90), (1.5, 8.0, 14)])
def test_a_camera_too_high_is_told_the_tilt_that_aims_it_at_the_floor_within_reach(height: float, max_range: float, degrees: int) -> None:
    """Three quarters of the range are the slope from the camera to the floor."""
    high = replace(SOUND, views_with_floor=1, camera_height=height)
    (finding,) = map_verdict.judge(high, max_range=max_range).findings
    assert f"{height:.1f} m high and looks 20 degrees down: floor seen in 1 of 100 views within {max_range:g} m" in finding.message
    assert f"by some {degrees} degrees" in finding.remedy


def test_the_figures_are_told_as_they_are() -> None:
    verdict = map_verdict.judge(replace(SOUND, path_known=0.246, views_doubled=30, doubled_by=0.123), max_range=4.0)
    assert verdict.summary == "20.0 m2 of free floor; 25% of the path known; floor seen in 90 of 100 views"
    doubled, path = verdict.findings
    assert "0.12 m apart, in 30 of 100 views" in str(doubled) and path.message.startswith("75% of the camera's path")
    plain = verdict.to_dict()
    assert plain["doubled_by"] == 0.123 and plain["path_known"] == 0.246 and plain["findings"][1]["is_grave"] is False
