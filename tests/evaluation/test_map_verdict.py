"""A map is judged by what was seen: each simulated fault gets its cause, sound drives get none, and the measures keep their laws."""

import json
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from boxroom import FURNITURE, KINECT, kinect_noise, look_along, render, round_trip
from hypothesis import given
from hypothesis import strategies as st

from slamcli.config.options import GridConfig, SensorConfig
from slamcli.depth import icp
from slamcli.evaluation import map_evidence, map_verdict
from slamcli.evaluation.map_evidence import FrameSurface
from slamcli.evaluation.map_verdict import DOUBLED, HOLES, NO_FLOOR, SMALL, TOO_HIGH, WALL, Verdict
from slamcli.navigation.grid import build_grid
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Grid, Ground

SETTINGS, SENSOR = GridConfig(), SensorConfig()


def recorded(T_lc, *, boxes=FURNITURE, far=4.0, holes=0.0, seed=0):
    """Return the noisy depth of every pose; a share `holes` of the pixels is lost in blocks, as on glass."""
    rng = np.random.default_rng(seed)
    images = []
    for T in T_lc:
        depth = kinect_noise(render(T, boxes=boxes), rng, far=far)
        lost = rng.random((12, 16)) < holes
        depth[np.kron(lost, np.ones((10, 10), bool))] = np.nan
        images.append(depth)
    return images


def views_of(images, T_lc):
    coarse = [icp.coarsen(depth) for depth in images]
    return [FrameSurface(T, icp.surface_points(c, KINECT, SENSOR), float((c == 0).mean())) for c, T in zip(coarse, T_lc, strict=True)]


def judged(T_lc, images, *, is_floor_found=True, placed=None) -> Verdict:
    """Judge the map of depth images taken at T_lc that the run believes to have been taken at `placed`."""
    placed = T_lc if placed is None else placed
    grid = build_grid(zip(images, placed, strict=True), KINECT, settings=SETTINGS, sensor=SENSOR)
    rows = np.unique(np.linspace(0, len(placed) - 1, 24).astype(int))
    views = views_of([images[i] for i in rows], placed[rows])
    evidence = map_evidence.measure(grid, placed, views, is_floor_found=is_floor_found, max_range=SETTINGS.max_range)
    return map_verdict.judge(evidence, max_range=SETTINGS.max_range)


def causes(verdict: Verdict) -> list[str]:
    return [finding.cause for finding in verdict.findings if finding.is_grave]


ROUND = round_trip(step=0.5, turn=0.4)


@cache
def round_recorded() -> list[np.ndarray]:
    return recorded(ROUND)


@cache
def round_judged() -> Verdict:
    return judged(ROUND, round_recorded())


def test_a_sound_drive_gets_no_finding() -> None:
    verdict = round_judged()
    assert verdict.is_usable
    assert verdict.findings == ()
    assert 10.0 < verdict.evidence.free_area < 40.0  # the room has 40 m2
    assert verdict.evidence.path_known > 0.7
    assert verdict.evidence.views_doubled == 0


def test_a_camera_too_high() -> None:
    T_lc = round_trip(height=2.3, pitch=0.05, step=0.4, turn=0.5)
    verdict = judged(T_lc, recorded(T_lc))
    assert causes(verdict) == [TOO_HIGH]
    assert "2.3 m high and looks 3 degrees down" in str(verdict.findings[0])
    assert "tilt it down by some 50 degrees" in str(verdict.findings[0])


def test_a_floor_never_seen() -> None:
    T_lc = round_trip(height=0.6, pitch=-0.45, step=0.4, turn=0.5)
    verdict = judged(T_lc, recorded(T_lc), is_floor_found=False)
    assert causes(verdict) == [NO_FLOOR]
    assert "floor seen in 0 of 24 views: tilt the camera down" in str(verdict.findings[0])


def test_depth_with_holes() -> None:
    verdict = judged(ROUND[:20], recorded(ROUND[:20], holes=0.55, far=1.6))
    assert causes(verdict)[0] == HOLES
    assert "% holes: keep 0.5 to 4 m away" in str(verdict.findings[0])


def test_a_flat_wall() -> None:
    T_lc = np.stack([look_along([x, 1.2, 1.2], -np.pi / 2, 0.0) for x in np.linspace(2.0, 6.0, 20)])
    verdict = judged(T_lc, recorded(T_lc, boxes=()), is_floor_found=False)
    assert causes(verdict) == [WALL, NO_FLOOR]
    assert "walk so that a corner and the floor are in view" in str(verdict.findings[0])


@pytest.mark.parametrize("apart", [0.15, 0.3])
def test_walls_that_lie_twice(apart: float) -> None:
    """The second round is placed beside the first, as when a loop was not closed."""
    T_lc = np.concatenate([ROUND, ROUND])
    placed = T_lc.copy()
    placed[len(ROUND) :, :2, 3] += apart / np.sqrt(2.0)
    verdict = judged(T_lc, round_recorded() * 2, placed=placed)
    assert causes(verdict) == [DOUBLED]
    assert 0.5 * apart < verdict.evidence.doubled_by < 1.2 * apart  # walls stand askew to the shift


def with_person(ahead: float, frames: set[int]) -> list[np.ndarray]:
    """Return the drive's depth with somebody so far ahead of the camera in some of the frames."""
    return [
        kinect_noise(render(T, boxes=(*FURNITURE, person(T, ahead))), np.random.default_rng(i), far=4.0) if i in frames else image
        for i, (T, image) in enumerate(zip(ROUND, round_recorded(), strict=True))
    ]


@pytest.mark.parametrize("ahead", [0.9, 1.4, 2.2])
def test_somebody_who_walks_through_is_no_double(ahead: float) -> None:
    """On the second round he goes before the camera for a quarter of it, unmasked: in front of walls, but not the walls once more."""
    images = with_person(ahead, set(range(len(ROUND) // 4)))
    verdict = judged(np.concatenate([ROUND, ROUND]), round_recorded() + images)
    assert verdict.findings == ()


def test_somebody_who_is_always_there_is_no_double_once_he_is_left_out() -> None:
    """Before a wall he hides most of it all the way round; `moving` leaves him out, as it does in a run."""
    images = with_person(0.9, set(range(len(ROUND))))
    gone = [np.abs(there - empty) > 0.2 for there, empty in zip(images, round_recorded(), strict=True)]
    assert np.median([mask.mean() for mask in gone]) > 0.1
    still = [np.where(mask, np.nan, image) for mask, image in zip(gone, images, strict=True)]
    T_lc = np.concatenate([ROUND, ROUND])
    assert causes(judged(T_lc, round_recorded() + still)) == []
    assert causes(judged(T_lc, round_recorded() + images)) == [DOUBLED]  # so much is asked of the mask


def person(T_lc: np.ndarray, ahead: float) -> tuple:
    """Return the box (low, high) [m] of somebody so far ahead of a camera, within the room."""
    forward = T_lc[:2, 2] / np.linalg.norm(T_lc[:2, 2])
    x, y = np.clip(T_lc[:2, 3] + ahead * forward, [0.3, 0.3], [7.7, 4.7])
    return (x - 0.25, y - 0.25, 0.0), (x + 0.25, y + 0.25, 1.8)


def test_little_floor_without_a_better_reason() -> None:
    T_lc = np.stack([look_along([6.8, 0.9, 0.7], yaw, 0.5) for yaw in np.linspace(-0.2, 0.2, 8)])
    verdict = judged(T_lc, recorded(T_lc))
    assert verdict.evidence.free_area < 2.0
    assert causes(verdict) == [SMALL]


def test_a_path_in_the_unknown_is_told_but_spoils_nothing() -> None:
    evidence = round_judged().evidence
    verdict = map_verdict.judge(replace(evidence, path_known=0.1), max_range=4.0)
    assert verdict.is_usable
    assert [finding.cause for finding in verdict.findings] == [map_verdict.OFF_PATH]


def test_the_verdict_as_plain_values_has_no_nan() -> None:
    evidence = replace(round_judged().evidence, is_floor_found=False, views_with_floor=0, camera_height=np.nan)
    plain = json.loads(json.dumps(map_verdict.judge(evidence, max_range=4.0).to_dict(), allow_nan=False))
    assert plain["camera_height"] is None and plain["doubled_by"] is None
    assert plain["is_usable"] is False
    assert plain["findings"][0]["cause"] == NO_FLOOR


def test_what_two_views_of_one_surface_say_of_each_other() -> None:
    T_lc = np.stack([look_along([x, 1.6, 1.2], -np.pi / 2, 0.0) for x in (4.0, 4.2)])  # before a wall
    a, b = views_of(recorded(T_lc, boxes=()), T_lc)
    agree, in_front = map_evidence.compare(a, b)
    assert agree > 300
    assert len(in_front) <= 0.01 * agree
    nearer = replace(a, T_lc=look_along([4.0, 1.85, 1.2], -np.pi / 2, 0.0))
    agree, in_front = map_evidence.compare(nearer, b)
    assert len(in_front) > 10 * agree
    assert np.median(in_front) == pytest.approx(0.25, abs=0.02)
    assert len(map_evidence.compare(b, nearer)[1]) == 0  # what lies behind a surface may be hidden, and says nothing
    away = replace(a, T_lc=look_along([4.0, 2.5, 0.6], np.pi, 0.2))
    assert map_evidence.compare(away, replace(b, T_lc=look_along([4.0, 2.5, 0.6], 0.0, 0.2)))[0] == 0


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), max_size=20))
def test_known_share_counts_places_one_by_one(places: list) -> None:
    state = np.random.default_rng(3).integers(-1, 2, (30, 20)).astype(np.int8)
    grid = Grid(np.zeros((30, 20), np.float32), np.ones((30, 20), np.int32), state, origin=np.array([-1.0, -2.0]), resolution=np.array(0.1))
    known = 0
    for x, y in places:
        column, row = int(np.floor((x + 1.0) / 0.1)), int(np.floor((y + 2.0) / 0.1))
        known += 0 <= row < 30 and 0 <= column < 20 and state[row, column] >= 0
    xyz = np.array([(x, y, 0.5) for x, y in places]).reshape(-1, 3)
    assert map_evidence.known_share(grid, xyz) == pytest.approx(known / len(places) if places else 0.0)


def test_a_run_is_judged(room_run) -> None:
    verdict = map_verdict.of_run(RunDir.find(str(room_run)))
    assert verdict is not None
    assert verdict.evidence.views == 40
    assert verdict.evidence.views_doubled == 0
    assert 0.0 < verdict.evidence.missing < 0.2
    assert causes(verdict) == [NO_FLOOR]  # it looks into a corner; its floor is not found


def test_the_end_of_a_run_tells_start_frames_and_verdict(slamcli, room_run, here) -> None:
    shutil.copytree(room_run, here / "runs" / "room")
    told = slamcli("run", "-r", "room").stderr.splitlines()
    assert "start       x 0.00 m, y 0.00 m, yaw 0.000 rad in the maps' frame" in told
    T_lw = RunDir.find("room").load(Ground, "densify").T_lw
    line = next(line for line in told if line.startswith("T_lw"))
    np.testing.assert_allclose([float(word) for word in line.split()[1:4]], T_lw[:3, 3], atol=1e-4)
    problem = told.index("problem     floor seen in 0 of 40 views")
    assert told[problem + 1].strip() == "-> tilt the camera down until the floor 1 to 2 m ahead is in the picture"
    made = json.loads(slamcli("run", "-r", "room", "--json").stdout)
    has_floor = bool((RunDir.find("room").load(Grid, "grid2d").state == 0).any())
    assert any("slamcli plan" in line for line in made["next"]) == has_floor  # no hint that can only fail
    assert made["map"]["findings"][0]["cause"] == NO_FLOOR
    np.testing.assert_allclose(made["frames"]["T_lw"], T_lw)
    assert made["frames"]["first"] == {"x": 0.0, "y": 0.0, "yaw": 0.0}
