"""A recording is spoilt in one way at a time; the inspection must name that fault, and keep silent about the sound recording."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import faults
import numpy as np
import pytest
from click.testing import Result

from slamcli.datasets import depth_unit, open_dataset, silent
from slamcli.datasets.simulate import simulate
from slamcli.geometry.depth_registration import Registration
from slamcli.inspection import ERROR, NOTE, WARNING, Inspection, findings, inspect, pictures, quick_look, registration

Command = Callable[..., Result]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds in a room, in small pictures."""
    folder = tmp_path_factory.mktemp("sound") / "room"
    simulate(folder, progress=silent, seed=3, frames=60, laps=0.2, rate=15.0, width=256, height=192)
    return folder


@pytest.fixture
def spoilt(sound: Path, tmp_path: Path) -> Iterator[Path]:
    yield faults.copy(sound, tmp_path / "spoilt")
    shutil.rmtree(tmp_path)


def alarms(found: Inspection) -> set[str]:
    return {finding.check for finding in found.findings if finding.level != NOTE}


def test_sound_recording_raises_no_alarm(sound: Path) -> None:
    found = inspect(str(sound))
    assert alarms(found) == set(), found.findings
    assert found.level == NOTE
    assert found.facts["frames"] == found.facts["frames_with_depth"] == 60
    assert found.facts["rate_hz"] == pytest.approx(15.0, abs=0.1)
    assert found.facts["depth_lag_s"] == pytest.approx(0.0, abs=0.015)
    assert max(map(abs, found.facts["depth_shift_px"])) <= 1
    assert found.facts["depth_q"] == pytest.approx(depth_unit.KINECT, rel=0.03)
    assert sum(n for _, _, n in found.facts["offset_histogram"]) == 60


@pytest.mark.parametrize("fault", faults.FAULTS, ids=lambda fault: fault.__name__)
def test_planted_fault_is_found(spoilt: Path, fault: Callable[[Path], None]) -> None:
    fault(spoilt)
    found = inspect(str(spoilt))
    assert alarms(found) & faults.FAULTS[fault], found.findings


@pytest.mark.slow
@pytest.mark.parametrize("fault", faults.VARIANTS, ids=lambda fault: fault.__name__)
def test_variant_of_a_fault_is_found(spoilt: Path, fault: Callable[[Path], None]) -> None:
    fault(spoilt)
    found = inspect(str(spoilt))
    assert alarms(found) & faults.VARIANTS[fault], found.findings


@pytest.mark.parametrize(
    "fault", [faults.swapped_stamps_far, faults.swapped_stamps_near, faults.depth_late], ids=lambda fault: fault.__name__
)
def test_fault_is_found_without_the_help_of_file_names(spoilt: Path, fault: Callable[[Path], None]) -> None:
    fault(spoilt)
    faults.anonymize(spoilt)
    assert alarms(inspect(str(spoilt))) & (faults.FAULTS | faults.VARIANTS)[fault]


@pytest.mark.parametrize(("dx", "dy", "late"), [(5, -4, 0.0), (0, 0, 0.05), (0, 0, -0.05)])
def test_shift_and_lag_are_measured(spoilt: Path, dx: int, dy: int, late: float) -> None:
    faults.repaint(spoilt, "depth", lambda d: faults.shifted(d, dx, dy))
    faults.make_late(spoilt, late)
    fit = registration.measure(open_dataset(str(spoilt)), workers=2)
    assert fit.shift == pytest.approx((-dx, -dy), abs=1.0)
    assert fit.lag == pytest.approx(late, abs=0.01)


def test_wrong_scale_is_guessed_both_ways(sound: Path) -> None:
    counts = pictures.look(open_dataset(str(sound)), workers=2, progress=silent).depth_counts
    in_millimetres = np.bincount(np.arange(len(counts)) // 5, counts, minlength=len(counts)).astype(np.int64)
    for readings, said, likely in ((counts, 5000, None), (counts, 1000, 5000), (in_millimetres, 5000, 1000), (in_millimetres, 1000, None)):
        assert depth_unit.judge(readings, said).likely_scale == likely


def test_scale_without_disparity_steps_is_judged_by_the_range() -> None:
    """A time-of-flight camera's readings have no such steps."""
    metres = np.random.default_rng(0).uniform(0.8, 4.0, 200_000)
    for true, said, likely in ((1000, 1000, None), (5000, 5000, None), (1000, 5000, 1000), (1000, 200, 1000)):
        counts = np.bincount(np.rint(metres * true).astype(int), minlength=65536)
        assert depth_unit.judge(counts, said).likely_scale == likely


def test_order_of_an_even_motion_is_left_alone() -> None:
    rng = np.random.default_rng(1)
    wall = cv2.GaussianBlur(rng.uniform(0, 255, (24, 400)).astype(np.float32), (0, 0), 6.0)
    at = np.cumsum(1.0 + 0.8 * np.sin(np.arange(60) / 5.0)).astype(int)
    still = np.stack([wall[:, x : x + 32] for x in at]) + rng.normal(0, 0.5, (60, 24, 32)).astype(np.float32)
    stamp = np.arange(60) / 30.0
    assert len(pictures.misplaced(still, stamp)) == 0
    swapped = still.copy()
    swapped[[20, 40]] = still[[40, 20]]
    assert pictures.misplaced(swapped, stamp).tolist() == [20, 40]
    assert len(pictures.misplaced(np.zeros((60, 24, 32), np.float32), stamp)) == 0
    assert len(pictures.misplaced(np.full((60, 24, 32), np.nan, np.float32), stamp)) == 0


def test_a_covered_lens_says_nothing_of_the_order() -> None:
    """Black pictures are told as black; that they do not follow from their neighbours is no second fault."""
    rng = np.random.default_rng(2)
    steps = np.cumsum(rng.normal(0.0, 1.0, (60, 24, 32)), axis=0).astype(np.float32) + 120.0
    steps[30:35] = 0.0
    stamp, seen = np.arange(60) / 30.0, SimpleNamespace(thumbnail=steps, mean_grey=steps.mean(axis=(1, 2)))
    assert len(pictures.misplaced(steps, stamp)) > 0
    assert len(pictures.misplaced(findings._lit(seen), stamp)) == 0


def test_blur_grows_with_blurring_and_a_blank_picture_has_none() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    effects = [pictures.blur_effect(cv2.GaussianBlur(picture, (0, 0), sigma)) for sigma in (0.5, 1.0, 2.0, 4.0)]
    assert effects == sorted(effects)
    assert 0.0 <= pictures.blur_effect(picture) < 0.4 < effects[-1] <= 1.0
    assert np.isnan(pictures.blur_effect(np.full((48, 64), 7, np.uint8)))


def test_command(slamcli: Command, sound: Path, spoilt: Path) -> None:
    good = slamcli("inspect", sound)
    assert good.exit_code == 0
    assert "verdict: good" in good.stdout
    faults.empty_depth(spoilt)
    bad = slamcli("inspect", spoilt, "--json")
    assert bad.exit_code == 1
    report = json.loads(bad.stdout)
    assert report["would_run"] is False
    assert {finding["level"] for finding in report["findings"]} == {ERROR}


def test_warning_does_not_change_the_status(slamcli: Command, spoilt: Path) -> None:
    faults.unsorted_list(spoilt)
    result = slamcli("inspect", spoilt, "--json")
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["would_run"] is True
    assert {finding["level"] for finding in report["findings"]} == {WARNING}


@pytest.mark.parametrize("content", ["", "# nothing\n", "not a list\n"])
def test_recording_that_cannot_be_opened(slamcli: Command, tmp_path: Path, content: str) -> None:
    (tmp_path / "rgb.txt").write_text(content)
    (tmp_path / "depth.txt").write_text(content)
    result = slamcli("inspect", tmp_path, "--json")
    assert result.exit_code == 1
    report = json.loads(result.stdout)
    assert report["would_run"] is False
    assert len(report["findings"]) == 1


def test_one_frame_and_damaged_images(spoilt: Path) -> None:
    for kind in ("rgb", "depth"):
        faults.write(spoilt, kind, faults.entries(spoilt, kind)[:1])
    assert inspect(str(spoilt)).level == NOTE
    name = faults.entries(spoilt, "rgb")[0][1]
    (spoilt / name).unlink()
    (spoilt / name).write_bytes(b"\x89PNG\r\n\x1a\nnonsense")
    found = inspect(str(spoilt))
    assert "files" in alarms(found) and found.level == ERROR


@pytest.mark.parametrize(("focal", "aside"), [(0.87, 0.015), (1.35, 0.025)])
def test_depth_of_another_camera_is_told_with_its_focal_length(spoilt: Path, focal: float, aside: float) -> None:
    camera = open_dataset(str(spoilt)).camera
    other, T_cd = replace(camera, fx=focal * camera.fx, fy=focal * camera.fy), np.eye(4)
    T_cd[0, 3] = aside
    seen = Registration(camera, other, np.linalg.inv(T_cd))
    faults.repaint(
        spoilt, "depth", lambda raw: np.rint(np.nan_to_num(seen.apply(camera.metres[raw])) * camera.depth_scale).astype(np.uint16)
    )
    found = inspect(str(spoilt))
    assert found.facts["depth_magnification"] == pytest.approx(1 / focal, rel=0.05)
    assert "registration" in alarms(found)
    looked = quick_look(open_dataset(str(spoilt)))
    assert any(finding.check == "registration" and "[depth] of camera.toml" in finding.advice for finding in looked)


def test_a_quick_look_has_nothing_to_say_of_a_sound_recording(sound: Path) -> None:
    assert quick_look(open_dataset(str(sound))) == []


@pytest.mark.parametrize(
    "fault", [faults.overexposed, faults.empty_depth, faults.blurred, faults.shifted_right], ids=lambda fault: fault.__name__
)
def test_a_quick_look_finds_what_would_spoil_a_run(spoilt: Path, fault: Callable[[Path], None]) -> None:
    fault(spoilt)
    assert {finding.check for finding in quick_look(open_dataset(str(spoilt)))} & faults.FAULTS[fault]
