"""Bundle adjustment: empty, weak and hostile problems."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scene import CAMERA, drive, pose_error

from slamcli.estimation import bundle_adjustment, bundle_kernels
from slamcli.estimation.bundle_problem import Observations, Problem, Variables
from slamcli.estimation.robust_loss import HUBER, LEAST_SQUARES
from slamcli.geometry import se3


def test_landmarks_seen_once_with_depth_are_placed_by_it():
    scene = drive(5, 120, noise=0.0)
    once = scene.keep(np.flatnonzero((scene.obs_lm >= 20) | (np.append(-1, scene.obs_lm[:-1]) != scene.obs_lm)))
    seen, count = np.unique(once.obs_lm, return_counts=True)
    result = bundle_adjustment.adjust(once.problem(), max_iterations=40, tolerance=1e-14)
    single = np.array([lm for lm, n in zip(seen, count, strict=True) if n == 1 and np.isfinite(once.depth[once.obs_lm == lm]).all()])
    assert len(single) > 5
    assert np.abs(result.x_w - scene.x_true)[single].max() < 1e-5


def test_a_landmark_with_one_bearing_bears_on_nothing():
    scene = drive(5, 120)
    extra = len(scene.x_w)
    with_bearing = replace(
        scene, x_w=np.vstack([scene.x_w, [[0.3, 0.2, 3.0], [0.0, 0.1, 2.0]]]), obs_kf=np.append(scene.obs_kf, [1, 3]),
        obs_lm=np.append(scene.obs_lm, [extra, extra + 1]), xy=np.vstack([scene.xy, [[300.0, 200.0], [100.0, 90.0]]]),
        depth=np.append(scene.depth, [np.nan, np.nan]), sigma_px=np.append(scene.sigma_px, [1.0, 1.0]),
        sigma_z=np.append(scene.sigma_z, [np.nan, np.nan]),
    )  # fmt: skip
    a, b = (bundle_adjustment.adjust(s.problem(), max_iterations=30, tolerance=1e-12) for s in (scene, with_bearing))
    np.testing.assert_allclose(b.T_cw, a.T_cw, atol=1e-7)
    assert np.isfinite(b.x_w).all() and (b.chi2[-2:] < 1e-3).all()
    x_c = se3.transform(b.T_cw[1], b.x_w[extra : extra + 1])[0]
    assert 0.5 < x_c[2] < 10.0


@pytest.mark.parametrize("left", [0, 1, 2, 3, 5])
def test_a_key_frame_with_few_observations_stays_near_and_harms_no_other(left):
    scene = drive(6, 150, seed=2)
    rows = np.flatnonzero(scene.obs_kf == 4)
    few = scene.keep(np.setdiff1d(np.arange(len(scene.xy)), rows[left:]))
    result = bundle_adjustment.adjust(few.problem(), max_iterations=20)
    others = [k for k in range(6) if k != 4]
    assert np.isfinite(result.T_cw).all()
    assert 1e-6 < np.abs(pose_error(result.T_cw, scene.T_true)[others]).max() < 0.02
    assert np.abs(pose_error(result.T_cw, scene.T_cw)[4]).max() < 0.1
    assert ((result.T_cw[4] == scene.T_cw[4]).all()) == (left == 0)


def test_values_that_are_not_finite_switch_their_observation_off():
    scene = drive(5, 100, seed=3)
    rows = np.array([3, 50, 90, 120])
    clean = bundle_adjustment.adjust(scene.keep(np.setdiff1d(np.arange(len(scene.xy)), rows)).problem())
    xy, sigma_px, depth, sigma_z = scene.xy.copy(), scene.sigma_px.copy(), scene.depth.copy(), scene.sigma_z.copy()
    xy[3, 1], xy[50, 0], sigma_px[90], sigma_px[120] = np.nan, np.inf, np.nan, 0.0
    depth[np.isnan(depth)] = np.inf  # no depth either
    sigma_z[np.isinf(depth)] = np.nan
    dirty = replace(scene, xy=xy, sigma_px=sigma_px, depth=depth, sigma_z=sigma_z)
    result = bundle_adjustment.adjust(dirty.problem())
    np.testing.assert_allclose(result.T_cw, clean.T_cw, atol=1e-12)
    assert not result.is_inlier[rows].any() and np.isinf(result.chi2[rows]).all()


def test_a_lost_landmark_and_one_behind_the_camera_do_not_spread():
    scene = drive(5, 100, seed=4)
    x_w = scene.x_w.copy()
    lost, behind = np.unique(scene.obs_lm)[[5, 9]]
    x_w[lost], x_w[behind] = np.nan, [0.0, 0.0, -5.0]
    rest = scene.keep(np.flatnonzero((scene.obs_lm != lost) & (scene.obs_lm != behind)))
    result = bundle_adjustment.adjust(replace(scene, x_w=x_w).problem(), max_iterations=20, tolerance=1e-9)
    clean = bundle_adjustment.adjust(rest.problem(), max_iterations=20, tolerance=1e-9)
    np.testing.assert_allclose(result.T_cw, clean.T_cw, atol=1e-5)
    assert np.isnan(result.x_w[lost]).all() and np.isfinite(np.delete(result.x_w, lost, axis=0)).all()
    wrong = np.isin(scene.obs_lm, [lost, behind])
    assert np.isinf(result.chi2[wrong]).all() and not result.is_inlier[wrong].any()


def test_empty_problems_come_back_as_they_went():
    nothing = np.zeros(0)
    T, x = np.eye(4)[None], np.zeros((0, 3))
    seen = Observations(nothing.astype(int), nothing.astype(int), np.zeros((0, 2)), nothing, nothing, nothing)
    result = bundle_adjustment.adjust(Problem(Variables(T, x), seen, CAMERA, is_fixed=np.array([False])))
    assert (result.T_cw == T).all() and result.cost == [0.0] and result.is_converged
    scene = drive(3, 30)
    only_landmarks = bundle_adjustment.adjust(scene.problem(is_fixed=np.ones(3, dtype=bool)))
    assert only_landmarks.cost[-1] < only_landmarks.cost[0] and (only_landmarks.T_cw == scene.T_cw).all()


def test_unsorted_observations_are_refused():
    scene = drive(3, 30)
    with pytest.raises(ValueError, match="sorted"):
        bundle_adjustment.adjust(scene.keep(np.arange(len(scene.xy))[::-1]).problem())


def test_the_order_of_key_frames_within_a_landmark_is_free():
    scene = drive(6, 80, seed=5)
    rng = np.random.default_rng(0)
    rows = np.lexsort((rng.random(len(scene.xy)), scene.obs_lm))
    a, b = (bundle_adjustment.adjust(s.problem()) for s in (scene, scene.keep(rows)))
    np.testing.assert_allclose(b.T_cw, a.T_cw, atol=1e-9)
    np.testing.assert_allclose(b.chi2, a.chi2[rows], rtol=1e-6, atol=1e-9)


def test_behind_the_camera_costs_the_same_in_every_kernel():
    scene = drive(3, 30, noise=0.0, start=0.0)
    x_w = scene.x_w.copy()
    x_w[scene.obs_lm[0]] = [0.0, 0.0, -1.0]
    behind = replace(scene, x_w=x_w)
    plain, problem = (behind.problem(loss=loss) for loss in (LEAST_SQUARES, HUBER))
    n = (scene.obs_lm == scene.obs_lm[0]).sum()
    np.testing.assert_allclose(plain.cost(plain.start), n * bundle_kernels.CHI2_BEHIND, rtol=1e-9)
    problem.linearize(problem.start)
    assert (problem.normal.V[scene.obs_lm[0]] == 0.0).all()
    assert (problem.normal.W[(scene.obs_lm == scene.obs_lm[0]) & (scene.obs_kf > 0)] == 0.0).all()
