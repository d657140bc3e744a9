"""A map says which number of its camera is wrong, and nothing where all are right."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_run import Run
from scenes import CAMERA, Scene, observe, orbit, room_points

from slamcli.calibration import plausibility, rolling_shutter, self_calibration
from slamcli.calibration.plausibility import Deviation, Rigidity, SeenTwice
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import SensorConfig
from slamcli.geometry import se3
from slamcli.schema import Timing
from slamcli.slam import calibration_doubt
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import optimize, track

WRONG = {  # what the calibration says, the finding, and the words with the right number
    "right": ({}, "", ""),
    "half": ({"fx": 260.0, "fy": 260.0}, "focal_length", "fx = 5"),
    "double": ({"fx": 1040.0, "fy": 1040.0}, "focal_length", "fx = 5"),
    "longer": ({"fx": 590.0, "fy": 590.0}, "focal_length", "fx = 5"),
    "aside": ({"cx": 360.0}, "principal_point", "(32"),
    "bent": ({"k1": 0.4}, "lens", "k1 = "),
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(3)
    nods = np.sin(np.outer(np.arange(40) / 6.0, [0, 0, 0, 1.0, 0.6, 0.8]) + np.arange(6)) * [0, 0, 0, 0.12, 0.06, 0.1]
    return observe(orbit(40, turns=0.15) @ se3.exp(nods), room_points(3000, rng), rng)


@pytest.mark.parametrize("case", WRONG)
def test_the_wrong_number_is_named(scene: Scene, case: str, tmp_path: Path) -> None:
    change, name, words = WRONG[case]
    given = replace(CAMERA, **change)
    features = scene.features
    if "k1" in change:  # extract takes the distortion out that the calibration says
        features = replace(features, xy=given.undistort(features.xy.astype(np.float64)).astype(np.float32))
    run = Run(replace(scene, features=features), tmp_path, given=given)
    for stage in (track, optimize):
        run.stage(stage)
    found = run.summary["optimize"].get("doubts", [])
    assert [one["name"] for one in found] == ([name] if name else [])
    assert all(one["is_grave"] and words in one["text"] for one in found)
    assert [one["text"] for one in found] == [text for text in run.warnings if "does not fit" in text]


def deviations_of(scene: Scene, run: Run, *, readout: float = 0.0, sigma: dict[str, float], sensor: SensorConfig) -> dict[str, Deviation]:
    """Adjust the tracked map as if the camera read its rows within `readout`, and ask it for its camera."""
    tracks, map_ = run.result("track")
    twist = rolling_shutter.frame_twists(scene.features.stamp, tracks, map_)
    now = Sensing(CAMERA, Timing(np.array(readout), np.array(0.0), depth_delay=np.array(0.0), twist=twist), sigma)
    sparse_map = SparseMap.from_map(scene.features, map_)
    sparse_map.features = self_calibration.correct(scene.features, CAMERA, now)
    map_adjustment.adjust(sparse_map, np.arange(len(sparse_map.kf), dtype=np.int32), CAMERA, sensor, max_iterations=20)
    return plausibility.deviations(sparse_map, now, sensor)


def test_a_readout_that_the_map_was_given_takes_the_place_of_no_principal_point(scene: Scene, tmp_path: Path) -> None:
    """A readout of 30 ms, of a camera that has none, moves the principal point by 2 % of the width unless it is asked anew as well."""
    run = Run(scene, tmp_path)
    run.stage(track)
    right = deviations_of(scene, run, sigma={}, sensor=run.cfg.sensor)
    alone = deviations_of(scene, run, readout=0.03, sigma={}, sensor=run.cfg.sensor)
    together = deviations_of(scene, run, readout=0.03, sigma={"readout": 0.02}, sensor=run.cfg.sensor)
    assert abs(alone["cx"].value - right["cx"].value) > 0.02
    assert abs(together["cx"].value - right["cx"].value) < 0.003


def test_how_sure_a_deviation_is_follows_from_the_residuals_and_not_from_what_was_believed_of_them(scene: Scene, tmp_path: Path) -> None:
    run = Run(scene, tmp_path)
    run.stage(track)
    believed = run.cfg.sensor
    twice = replace(
        believed,
        pixel_noise=2 * believed.pixel_noise,
        depth_noise_base=2 * believed.depth_noise_base,
        depth_noise_quadratic=2 * believed.depth_noise_quadratic,
    )
    one, other = (deviations_of(scene, run, sigma={}, sensor=sensor) for sensor in (believed, twice))
    assert all(0.8 < other[name].sigma / one[name].sigma < 1.25 for name in ("focal", "cx", "cy", "k1"))


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0, 1.3, 2.0])
def test_points_seen_twice_are_rigid_under_the_right_focal_length_alone(factor: float) -> None:
    """Found whatever the camera is believed to be, with a fifth of the matches false."""
    rng = np.random.default_rng(5)
    views = []
    for _ in range(6):
        points = rng.uniform([-1.5, -1.2, 1.0], [1.5, 1.2, 4.0], (150, 3))
        T = se3.exp(rng.normal(0.0, [0.2, 0.2, 0.2, 0.15, 0.15, 0.15]))
        both = []
        for x in (points, se3.transform(T, points)):
            depth = x[:, 2] + rng.normal(0.0, 0.01, len(x))
            both.append(SeenTwice(CAMERA.project(x) + rng.normal(0.0, 0.5, (len(x), 2)), depth))
        order = np.concatenate([rng.permutation(30), np.arange(30, 150)])
        views.append((both[0], SeenTwice(both[1].xy[order], both[1].depth[order])))
    believed = replace(CAMERA, fx=CAMERA.fx / factor, fy=CAMERA.fy / factor)
    found = plausibility.most_rigid(views, believed, SensorConfig())
    assert found is not None and found.pairs == 6
    assert found.factor == pytest.approx(factor, rel=0.04)
    assert 0.99 < found.gain < 1.02 if factor == 1.0 else found.gain > 1.02


def test_too_few_points_say_nothing() -> None:
    few = SeenTwice(np.zeros((5, 2)), np.ones(5))
    assert plausibility.most_rigid([(few, few)], CAMERA, SensorConfig()) is None
    assert plausibility.most_rigid([], CAMERA, SensorConfig()) is None


def test_the_greatest_fault_is_named_alone_and_small_or_unsure_ones_never() -> None:
    found = {"focal": Deviation(0.07, 0.001), "cx": Deviation(-0.05, 0.001), "cy": Deviation(0.0, 0.001), "k1": Deviation(0.3, 0.1)}
    assert [one.name for one in calibration_doubt.about(found, None, CAMERA)] == ["principal_point"]
    assert calibration_doubt.about({"focal": Deviation(0.07, 0.004)}, None, CAMERA) == []
    assert calibration_doubt.about({"focal": Deviation(0.05, 0.001)}, None, CAMERA) == []
    assert calibration_doubt.about({}, Rigidity(0.7, 1.1, 20), CAMERA) == []
    assert [one.name for one in calibration_doubt.about(found, Rigidity(0.5, 2.0, 20), CAMERA)] == ["focal_length"]
    assert [one.name for one in calibration_doubt.about(dict.fromkeys(("shift_x", "shift_y"), Deviation(0.02, 0.001)), None, CAMERA)] == [
        "depth_shift"
    ]
