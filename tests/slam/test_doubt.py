"""Findings: kept in a stage's summary, collected, summed up."""

import json

import numpy as np
import pytest

from slamcli.slam import doubt
from slamcli.slam.doubt import Finding

GRAVE = Finding("focal_length", "the focal length does not fit by 8 %: give the right camera.json", is_grave=True)
MILD = Finding("moving_objects", "a third of the views moves in 20 frames")


def test_findings_survive_the_record_and_grave_ones_come_first() -> None:
    records = {
        "track": {"summary": json.loads(json.dumps({"frames": 3} | doubt.to_summary([MILD])))},
        "optimize": None,
        "loop": {"summary": doubt.to_summary([GRAVE, MILD])},
        "octree": {},
    }
    assert doubt.from_records(records) == [GRAVE, MILD]


def test_without_findings_a_summary_has_no_word_of_doubt() -> None:
    assert doubt.to_summary([]) == {} and doubt.from_records({"track": {"summary": {}}}) == []


def test_only_grave_findings_put_the_whole_in_doubt() -> None:
    assert doubt.headline([MILD]) == ""
    said = doubt.headline([MILD, GRAVE])
    assert GRAVE.text in said and MILD.text not in said and "\n" not in said


def collected(*names: str) -> list[str]:
    """Collect findings, of which those in capitals are grave, and give back their names."""
    findings = [Finding(name.lower(), name, is_grave=name.isupper()) for name in names]
    return [finding.text for finding in doubt.from_records({"track": {"summary": doubt.to_summary(findings)}})]


def test_a_grave_cause_leaves_out_what_follows_from_it_and_nothing_else() -> None:
    assert collected("lens", "REGISTRATION", "poses") == ["REGISTRATION", "poses"]
    assert collected("REGISTRATION", "FROZEN", "focal_length", "POSES") == ["FROZEN", "POSES"]
    assert collected("FROZEN", "frozen_depth", "DEPTH_READINGS") == ["FROZEN", "DEPTH_READINGS", "frozen_depth"]
    assert collected("registration", "LENS") == ["LENS", "registration"], "a mild one explains nothing"
    assert collected("LENS", "focal_length") == ["LENS", "focal_length"]


def test_findings_are_added_to_those_that_are_there() -> None:
    summary = {"frames": 3} | doubt.to_summary([MILD])
    assert doubt.joined(summary, []) == summary
    assert doubt.joined(summary, [GRAVE]) == {"frames": 3} | doubt.to_summary([MILD, GRAVE])
    assert doubt.joined({"frames": 3}, [GRAVE]) == {"frames": 3} | doubt.to_summary([GRAVE])


@pytest.mark.parametrize(
    ("frames", "stretches"), [([], []), ([0, 0], []), ([1, 1, 0, 1], [(0, 1), (3, 3)]), ([0, 1, 1, 1], [(1, 3)]), ([1], [(0, 0)])]
)  # fmt: skip
def test_stretches_cover_exactly_the_doubtful_frames(frames: list[int], stretches: list) -> None:
    assert doubt.doubtful_frames(np.array(frames, dtype=bool)) == stretches
