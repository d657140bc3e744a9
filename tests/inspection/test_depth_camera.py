"""The camera of depth that was never registered is found, said, kept with the run; registered depth is left alone."""

from collections.abc import Callable
from pathlib import Path

import cv2
import faults
import numpy as np
import pytest
from click.testing import Result

from slamcli.config.options import RecordingConfig
from slamcli.datasets import open_dataset, silent
from slamcli.datasets.simulate import simulate
from slamcli.errors import SlamError
from slamcli.estimation.shared_parameters import SharedEvidence
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_registration import Registration
from slamcli.inspection import depth_camera, registration
from slamcli.runs.run_directory import RunDir

FOCAL, ASIDE, TURN = 293.0, 0.025, np.radians(0.5) * np.array([0.5, 0.7, 0.5])  # colour: 262.7 px


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("sound") / "room", progress=silent, seed=7, frames=48, laps=0.18, width=320, height=240)


@pytest.fixture(scope="module")
def unregistered(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    numbers = np.array([np.log(FOCAL), 159.5, 119.5, *TURN, ASIDE, 0.0, 0.0])
    return as_seen_by(sound, tmp_path_factory.mktemp("unregistered") / "room", numbers)


def as_seen_by(sound: Path, out: Path, numbers: np.ndarray) -> Path:
    """Copy the recording with depth as a camera of these numbers sees it."""
    folder, dataset = faults.copy(sound, out), open_dataset(str(sound))
    camera = Camera(320, 240, np.exp(numbers[0]), np.exp(numbers[0]), *numbers[1:3], depth_scale=dataset.camera.depth_scale)
    seen_by = Registration(dataset.camera, camera, se3.inverse(depth_camera.transform(numbers[3:6], numbers[6:9])))
    for i, name in enumerate(dataset.depth_name):
        raw = np.rint(np.nan_to_num(seen_by.apply(dataset.depth(i)) * dataset.camera.depth_scale)).astype(np.uint16)
        (folder / name).unlink()
        cv2.imwrite(str(folder / name), raw)
    return folder


@pytest.mark.slow
def test_depth_that_is_registered_is_no_other_cameras(sound: Path) -> None:
    found = depth_camera.find(open_dataset(str(sound)))
    assert found is not None and not found.is_sure


@pytest.mark.shows("recording.depth_camera")
def test_the_option_registers_depth(unregistered: Path, sound: Path) -> None:
    option = f"{FOCAL} {FOCAL} 159.5 119.5 {ASIDE} 0 0 {' '.join(map(str, TURN))}"
    dataset, true = open_dataset(str(unregistered), options=RecordingConfig(depth_camera=option)), open_dataset(str(sound))
    assert dataset.depth_camera is not None and dataset.digest() != open_dataset(str(unregistered)).digest()
    error = np.concatenate([(dataset.depth(i) - true.depth(i)).ravel() for i in (0, 20, 40)])
    error = np.abs(error[np.isfinite(error)])
    assert 1e-5 < np.median(error) < 0.01 and (error < 0.03).mean() > 0.9
    fit = registration.measure(dataset, workers=1)
    assert fit.magnification is None and max(map(abs, fit.shift)) <= 1


@pytest.mark.parametrize("option", ["1 2 3", "a b c d e f g h i j", "0 0 0 0 0 0 0 0 0 0"])
def test_an_option_that_makes_no_camera_is_refused(sound: Path, option: str) -> None:
    with pytest.raises(SlamError, match=r"depth_camera"):
        open_dataset(str(sound), options=RecordingConfig(depth_camera=option))


def test_run_says_what_it_found_and_keeps_it(unregistered: Path, tmp_path: Path, slamcli: Callable[..., Result]) -> None:
    result = slamcli("run", unregistered, "-r", tmp_path / "run", "--until", "extract")
    assert result.exit_code == 0 and "registered on reading, as its edges and the map tell" in result.stderr and "+-" in result.stderr
    run = RunDir(tmp_path / "run")
    fx, fy, cx, cy, x, y, z, *turn = map(float, run.config().recording.depth_camera.split())
    assert fx == fy and abs(fx - FOCAL) < 0.005 * FOCAL and abs(z) < 0.002
    assert abs(x - ASIDE) < 0.006 and abs(y) < 0.006
    # A turn and a principal point that is off by as much look nearly alike: where the pixel of the axis comes to lie tells more.
    seen = np.array([cx - 159.5, cy - 119.5]) - FOCAL * np.array([turn[1] - TURN[1], TURN[0] - turn[0]])
    assert np.abs(seen).max() < 1.5 and abs(turn[2] - TURN[2]) < 0.004
    assert [(one["name"], one["is_grave"]) for one in run.record("extract")["summary"]["doubts"]] == [("depth_camera", False)]
    again = slamcli("run", unregistered, "-r", tmp_path / "run", "--until", "extract")
    assert again.exit_code == 0 and "up to date" in again.stderr


def test_a_principal_point_aside_costs_no_focal_length(sound: Path, tmp_path: Path) -> None:
    numbers = np.array([np.log(FOCAL), 164.0, 116.0, *TURN, ASIDE, 0.0, 0.0])
    found = depth_camera.find(open_dataset(str(as_seen_by(sound, tmp_path / "room", numbers))))
    error = found.numbers - numbers
    assert found.is_sure and (np.abs(error) < 3.0 * found.sigma).all()
    assert abs(error[0]) < 0.005 and found.sigma[0] < 0.005
    # A turn does nearly the same; what both do to the middle of the image is known.
    assert np.abs(error[1:3] - FOCAL * np.array([error[4], -error[3]])).max() < 2.5


def test_a_map_is_heard_that_the_edges_do_not_contradict() -> None:
    edges = depth_camera.DepthCamera(np.zeros(9), np.diag(np.full(9, 4.0)), 4.0, 1.0, 500.0)
    near = edges.told_by(SharedEvidence(np.diag(np.full(9, 12.0)), np.full(9, 6.0)))
    np.testing.assert_allclose(near.numbers, 1.5 / 7.0)
    np.testing.assert_allclose(near.sigma, 1.0 / np.sqrt(7.0))
    assert edges.told_by(SharedEvidence(np.diag(np.full(9, 12.0)), np.full(9, 36.0))) is edges


@pytest.mark.shows("recording.find_depth_camera")
def test_it_can_be_switched_off(unregistered: Path, tmp_path: Path, slamcli: Callable[..., Result]) -> None:
    result = slamcli("run", unregistered, "-r", tmp_path / "run", "--until", "extract", "-s", "recording.find_depth_camera=false")
    assert result.exit_code == 0
    run = RunDir(tmp_path / "run")
    assert run.config().recording.depth_camera == ""
    assert [one["name"] for one in run.record("extract")["summary"]["doubts"] if one["is_grave"]] == ["registration"]
