"""What a recording says about its own camera: errors put into it are found, and what cannot be found is said to be unknown."""

from dataclasses import replace

import numpy as np
import pytest
from scene_run import Run
from scenes import CAMERA, Scene, ape, observe, orbit, room_points

from slamcli.calibration import measurement_derivatives, rolling_shutter, self_calibration
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import OptimizeConfig, SensorConfig
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Timing, frame_poses
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import loop, optimize, track

SENSOR = SensorConfig(depth_noise_base=0.0012, depth_noise_quadratic=0.0019, pixel_noise=0.5)  # the noise that `observe` makes


def turn(turns: float, *, frames: int, per_frame: int = 400) -> Scene:
    rng = np.random.default_rng(0)
    return observe(orbit(frames, turns=turns), room_points(2500, rng), rng, per_frame=per_frame)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return turn(0.06, frames=14, per_frame=600)


def shaking() -> Scene:
    """Let a hand hold the camera, and let landmarks lie on surfaces that slant as floors and walls do."""
    rng, seconds = np.random.default_rng(0), np.arange(40) / 30.0
    swing = np.sin(np.outer(seconds, [5.7, 8.2, 6.9, 5.0, 7.5, 6.3]) + np.arange(6)) * [0.05, 0.05, 0.05, 0.07, 0.07, 0.07]
    made = observe(orbit(40, turns=0.02) @ se3.exp(swing), room_points(2500, rng), rng, per_frame=600)
    slope = rng.normal([0.0004, -0.0003], 0.0006, (len(made.landmark), 2))
    return replace(made, features=replace(made.features, slope=slope.astype(np.float32)))


def build(scene: Scene, features: Features) -> SparseMap:
    """Make every frame a key frame at its true pose, and every true landmark one of the map."""
    sparse_map, id_of = SparseMap(features), np.full(len(scene.xyz), -1, np.int32)
    for frame, T_gc in enumerate(scene.T_gc):
        kf = sparse_map.add_key_frame(frame, T_gc)
        rows = np.arange(features.offset[frame], features.offset[frame + 1])
        of = scene.landmark[rows]
        is_known = id_of[of] >= 0
        sparse_map.observe(kf, id_of[of[is_known]], rows[is_known])
        id_of[of[~is_known]] = sparse_map.add_landmarks(kf, rows[~is_known], scene.xyz[of[~is_known]])
    return sparse_map


def moving(scene: Scene, *, readout: float = 0.0, depth_readout: float = 0.0, depth_delay: float = 0.0) -> Timing:
    twist = rolling_shutter.twists(np.asarray(scene.features.stamp), scene.T_gc)
    return Timing(np.array(readout), np.array(depth_readout), np.array(depth_delay), twist)


def look(
    scene: Scene, features: Features, given: Camera, option: OptimizeConfig, *, rounds: int = 3, sensor: SensorConfig = SENSOR
) -> Sensing:
    """Adjust and estimate in turns, as optimize does."""
    sparse_map, sensing = build(scene, features), Sensing(given, moving(scene), {})
    prior, kfs = self_calibration.unknowns(given, option), np.arange(len(scene.T_gc), dtype=np.int32)
    for _ in range(rounds):
        sparse_map.features = self_calibration.correct(features, given, sensing)
        map_adjustment.adjust(sparse_map, kfs, sensing.camera, sensor, max_iterations=15)
        sensing = self_calibration.estimate_sensing(sparse_map, given, sensing, sensor, prior=prior)
    return sensing


def test_timing_that_was_put_in_is_found_within_its_sigma():
    """Under the wide noise of the defaults: what lies outside a narrow one before the timing is known is never asked again."""
    scene, true = shaking(), {"readout": 0.018, "depth_readout": 0.024, "depth_delay": -0.012}
    shaken = rolling_shutter.rectify(scene.features, moving(scene, **{name: -value for name, value in true.items()}), CAMERA)
    found = look(scene, shaken, CAMERA, OptimizeConfig(), sensor=SensorConfig())
    for name, value in true.items():
        error = abs(float(getattr(found.timing, name)) - value)
        assert 1e-6 < error < 3.0 * found.sigma[name] and found.sigma[name] < 0.003
    assert set(found.sigma) == set(true) and found.camera == CAMERA
    level = look(scene, replace(shaken, slope=0 * shaken.slope), CAMERA, OptimizeConfig(), sensor=SensorConfig())
    assert level.sigma["depth_delay"] > 2.0 * found.sigma["depth_delay"]  # slanted surfaces tell most


def test_what_does_not_differ_from_what_was_believed_stays(scene):
    found = look(scene, scene.features, CAMERA, OptimizeConfig(intrinsics=True))
    assert found.camera == CAMERA and all(getattr(found.timing, name) == 0.0 for name in measurement_derivatives.TIMES)
    assert all(sigma > 0.0 for sigma in found.sigma.values()) and len(found.sigma) == 7


@pytest.mark.shows("optimize.intrinsics")
def test_intrinsics_that_were_put_in_are_found_within_their_sigma():
    scene, given = turn(0.25, frames=40), replace(CAMERA, fx=523.0, fy=517.0, cx=321.5, cy=238.8)
    found = look(scene, scene.features, given, OptimizeConfig(readout=False, depth_delay=False, intrinsics=True))
    for name in ("fx", "fy", "cx", "cy"):
        assert 1e-6 < abs(getattr(found.camera, name) - getattr(CAMERA, name)) < 4.0 * found.sigma[name]
    # A camera that turns about its own upright axis learns nothing of the upright focal length.
    assert found.sigma["fx"] < 1.0 and found.sigma["cx"] < 1.0 and found.sigma["fy"] > 0.9 * 0.02 * given.fy


@pytest.mark.shows("optimize.depth_scale")
def test_an_offset_of_inverse_depth_is_found_within_its_sigma_and_a_factor_is_said_to_be_unknown():
    scene, offset, factor = turn(0.25, frames=40), 0.02, 0.99
    read = 1.0 / ((1.0 / scene.features.depth - offset) * factor)
    shifted = replace(scene.features, depth=read.astype(np.float32))
    option = OptimizeConfig(readout=False, depth_delay=False, depth_scale=True)
    found = look(scene, shifted, CAMERA, option)
    assert 1e-6 < abs(found.camera.inverse_depth_offset - offset) < 4.0 * found.sigma["inverse_depth_offset"]
    assert found.sigma["inverse_depth_offset"] < 0.004
    share = found.sigma["depth_scale"] / CAMERA.depth_scale
    assert 0.95 * option.depth_scale_prior < share <= option.depth_scale_prior
    # What is told of depth at all is at the depths seen, some 2 m: no size there has changed.
    depth = found.camera.reread(np.array([2.0]), CAMERA)
    assert abs(depth[0] / 2.0 - 1.0) < 0.02


def test_depth_without_error_stays_as_it_was_read(scene):
    found = look(scene, scene.features, CAMERA, OptimizeConfig(depth_scale=True))
    assert found.camera == CAMERA


def test_the_map_is_made_with_the_camera_that_was_found(tmp_path):
    """A guessed calibration bends the path; with it found, the path is as good as with the true one, and later stages know it."""
    scene, guess = turn(0.5, frames=80, per_frame=300), replace(CAMERA, fx=508.0, fy=508.0, cx=325.0)
    error = {}
    for name, given, option in (
        ("true", CAMERA, OptimizeConfig()),
        ("guessed", guess, OptimizeConfig()),
        ("found", guess, OptimizeConfig(intrinsics=True)),
    ):
        (tmp_path / name).mkdir()
        run = Run(scene, tmp_path / name, given=given, optimize=option)
        for stage in (track, optimize, loop):
            run.stage(stage)
        tracks, map_ = run.result("loop")
        error[name] = ape(frame_poses(tracks, map_), scene.T_gc)
        assert run.camera("loop") == run.camera("optimize")
        assert (run.camera("loop") == given) == (name != "found")
    assert 0.0 < error["found"] < 0.5 * error["guessed"] and error["found"] < 1.5 * error["true"]


def test_features_under_another_calibration_keep_their_rays_and_return(scene):
    lens = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, k1=0.26, k2=-0.95, p1=-0.005, p2=0.0026, k3=1.16)
    other = replace(lens, fx=520.0, cy=250.0, k1=0.25)
    there = self_calibration.recalibrate(scene.features, lens, other)
    assert np.abs(there.xy - scene.features.xy).max() > 1.0
    np.testing.assert_array_equal(there.depth, scene.features.depth)
    raw = lens.distort(scene.features.xy[:500])
    np.testing.assert_allclose(there.xy[:500], other.undistort(raw), atol=1e-3)
    back = self_calibration.recalibrate(there, other, lens)
    np.testing.assert_allclose(back.xy, scene.features.xy, atol=5e-3)


@pytest.mark.shows("optimize.move_depth")
def test_depth_without_a_delay_to_go_by_stays_where_it_is(scene):
    unmoved = rolling_shutter.rectify(scene.features, moving(scene, readout=0.02, depth_delay=np.nan), CAMERA)
    np.testing.assert_array_equal(unmoved.depth, scene.features.depth)
    assert list(self_calibration.unknowns(CAMERA, OptimizeConfig(move_depth=False))) == ["readout"]


@pytest.mark.shows("optimize.readout", "optimize.depth_delay")
def test_times_that_are_not_looked_for_stay(scene):
    shaken = rolling_shutter.rectify(scene.features, moving(scene, readout=-0.02, depth_delay=0.01), CAMERA)
    for option, sought in (
        (OptimizeConfig(readout=False), {"depth_delay"}),
        (OptimizeConfig(depth_delay=False), {"readout", "depth_readout"}),
    ):
        found = look(scene, shaken, CAMERA, option, rounds=1)
        assert set(found.sigma) == sought
        assert all(getattr(found.timing, name) == 0.0 for name in set(measurement_derivatives.TIMES) - sought)


@pytest.mark.shows("optimize.focal_prior", "optimize.centre_prior")
def test_intrinsics_move_no_farther_than_they_are_believed_to_be_off():
    scene, given = turn(0.25, frames=30), replace(CAMERA, fx=530.0, cx=326.0)
    option = OptimizeConfig(readout=False, depth_delay=False, intrinsics=True)
    free = look(scene, scene.features, given, option, rounds=2)
    sure_of_focal, sure_of_centre = (
        look(scene, scene.features, given, replace(option, **prior), rounds=2) for prior in ({"focal_prior": 1e-6}, {"centre_prior": 1e-3})
    )
    assert abs(free.camera.fx - CAMERA.fx) < 4.0 < 6.0 < abs(free.camera.fx - given.fx)
    assert abs(sure_of_focal.camera.fx - given.fx) < 0.1 and abs(sure_of_focal.camera.cx - given.cx) > 1.0
    assert abs(sure_of_centre.camera.cx - given.cx) < 0.1 and abs(sure_of_centre.camera.fx - given.fx) > 1.0


@pytest.mark.shows("optimize.inverse_depth_prior", "optimize.depth_scale_prior")
def test_depth_changes_no_more_than_it_is_believed_to_be_off():
    scene = turn(0.25, frames=30)
    shifted = replace(scene.features, depth=(1.0 / (1.0 / scene.features.depth - 0.02)).astype(np.float32))
    option = OptimizeConfig(readout=False, depth_delay=False, depth_scale=True)
    free, sure = (
        look(scene, shifted, CAMERA, replace(option, inverse_depth_prior=prior, depth_scale_prior=prior), rounds=2)
        for prior in (0.02, 1e-5)
    )
    assert free.camera.inverse_depth_offset == pytest.approx(0.02, abs=0.01) and abs(sure.camera.inverse_depth_offset) < 1e-4
    share = [found.sigma["depth_scale"] / CAMERA.depth_scale for found in (free, sure)]
    assert share[0] > 0.01 and share[1] == pytest.approx(1e-5, rel=0.1)


@pytest.mark.shows("optimize.timing_prior")
def test_times_move_no_farther_from_0_than_they_are_believed_to_be():
    scene = shaking()
    shaken = rolling_shutter.rectify(scene.features, moving(scene, readout=-0.018), CAMERA)
    free, sure = (look(scene, shaken, CAMERA, OptimizeConfig(timing_prior=prior), rounds=1) for prior in (0.02, 1e-6))
    assert float(free.timing.readout) > 0.005 and abs(float(sure.timing.readout)) < 1e-4
