"""Kernels of camera_pose.py: ranking of RANSAC's hypotheses, and Levenberg-Marquardt on the motion alone.

Poses are arrays [R | t], (3, 4) or (4, 4). `ray` is the undistorted pixel on the plane z = 1. An observation's depth is NaN where the
sensor gave none. All arrays are C-contiguous float64 unless said otherwise.
"""

from typing import NamedTuple

import numpy as np
from numba import b1, f8, i8

from slamcli.estimation.robust_loss import Huber
from slamcli.geometry import elementary
from slamcli.geometry.cholesky import solve_damped
from slamcli.geometry.se3 import left_update
from slamcli.geometry.six import six, store
from slamcli.jit.kernel import kernel

Z_MIN = 1e-2  # [m] a landmark nearer to the image plane than this, or behind it, has no projection
CHI2_BEHIND = 1e6  # what such an observation costs: more than any that can be seen, yet finite
DAMPING_START, DAMPING_MIN, DAMPING_MAX = 1e-4, 1e-9, 1e6  # factor on the diagonal; beyond, no step lowers the cost
# Levenberg-Marquardt between two sortings into inliers and outliers, and how often they are sorted at most, as in ORB-SLAM.
ITERATIONS, ROUNDS = 10, 4


class Hypotheses(NamedTuple):
    """Candidate motions, each tested against all points."""

    T: f8[:, :, ::1]  # (M, 3, 4), one per round; NaN = its sample had no solution
    p: f8[:, ::1]  # (N, 3) m
    ray: f8[:, ::1]  # (N, 2)


class Agreement(NamedTuple):
    """When a point agrees with a hypothesis, and when enough hypotheses were looked at."""

    fx: f8  # px
    fy: f8
    threshold2: f8  # px^2, squared reprojection error of an inlier
    size: i8  # points of a sample
    confidence: f8  # of having drawn a sample of inliers alone


class Seen(NamedTuple):
    """Observations of landmarks, and how well they measure."""

    x_w: f8[:, ::1]  # (N, 3) m; NaN = never in front of the camera
    xy: f8[:, ::1]  # (N, 2) px
    depth: f8[::1]  # (N,) m
    inv_px: f8[::1]  # (N,) 1/px, inverse standard deviations
    inv_z: f8[::1]  # (N,) 1/m


class System(NamedTuple):
    """What observations say of a pose: of a small motion of it, and how well each agrees."""

    H: f8[:, ::1]  # (6, 6)
    b: f8[::1]  # (6,)
    chi2: f8[::1]  # (N,)


@kernel(error_model="numpy")
def _reprojection2(tested, h, i, fx, fy):
    """Squared reprojection error [px^2] of point i under hypothesis h."""
    T, p, ray = tested.T[h], tested.p, tested.ray
    z = T[2, 0] * p[i, 0] + T[2, 1] * p[i, 1] + T[2, 2] * p[i, 2] + T[2, 3]
    if not z > Z_MIN:
        return CHI2_BEHIND
    du = fx * ((T[0, 0] * p[i, 0] + T[0, 1] * p[i, 1] + T[0, 2] * p[i, 2] + T[0, 3]) / z - ray[i, 0])
    dv = fy * ((T[1, 0] * p[i, 0] + T[1, 1] * p[i, 1] + T[1, 2] * p[i, 2] + T[1, 3]) / z - ray[i, 1])
    return du * du + dv * dv


@kernel(error_model="numpy")
def rank(there: Hypotheses, back: Hypotheses, is_two_way: b1, rule: Agreement, is_inlier: b1[::1]):
    """Find the best of the hypotheses; write its inliers; return its number, -1 = none, and the rounds done.

    back : if is_two_way, the inverse motions, under which the other camera's points are to fall on their rays, too
    Hypotheses are ranked by the truncated sum of squares (P. Torr, A. Zisserman, MLESAC, CVIU 2000, doi:10.1006/cviu.1999.0832). Rounds
    end once a sample of inliers alone was drawn with the confidence of the rule.
    """
    n, n_hypotheses, threshold2 = len(there.p), len(there.T), rule.threshold2
    best, best_score, needed, done = -1, np.inf, n_hypotheses, 0
    while done < needed:
        h = done
        done += 1
        if there.T[h, 0, 0] != there.T[h, 0, 0]:
            continue
        score, count = 0.0, 0
        for i in range(n):
            error = _reprojection2(there, h, i, rule.fx, rule.fy)
            if is_two_way:
                error = max(error, _reprojection2(back, h, i, rule.fx, rule.fy))
            if error < threshold2:
                score += error / threshold2
                count += 1
            else:
                score += 1.0
            if score >= best_score:
                break
        if score < best_score and count > 0:
            best, best_score = h, score
            missed = 1.0 - elementary.whole_power(count / n, rule.size)
            if missed < 1.0:
                rounds = 0 if missed <= 0.0 else int(elementary.logarithm(1.0 - rule.confidence) / elementary.logarithm(missed)) + 1
                needed = min(n_hypotheses, rounds)
    if best >= 0:
        for i in range(n):
            error = _reprojection2(there, best, i, rule.fx, rule.fy)
            if is_two_way:
                error = max(error, _reprojection2(back, best, i, rule.fx, rule.fy))
            is_inlier[i] = error < threshold2
    return best, done


@kernel(error_model="numpy")
def normal_equations(T, seen, is_used, camera, loss, out):
    """Write H = sum w J^T J (upper triangle), b = -sum w J^T r, and chi2 at pose T; return the robust cost.

    J is minus (8), as r = prediction - measurement, with the row of the depth residual below it:
    d z / d xi = [0 0 1 Y -X 0]. w is Huber's weight of the whole observation.
    """
    x_w, xy, depth, inv_px, inv_z = seen
    H, b, chi2 = out
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    robust = np.isfinite(loss.pixel) and np.isfinite(loss.with_depth)
    h0 = h1 = h2 = h3 = h4 = h5 = six(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    b0 = b1 = b2 = b3 = b4 = b5 = cost = 0.0
    for i in range(len(x_w)):
        px, py, pz = x_w[i, 0], x_w[i, 1], x_w[i, 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if not z > Z_MIN:
            chi2[i] = CHI2_BEHIND
            if is_used[i]:
                cost += 2.0 * np.sqrt(loss.pixel * CHI2_BEHIND) if robust else CHI2_BEHIND
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        inv = 1.0 / z
        ru, rv = (fx * x * inv + cx - xy[i, 0]) * inv_px[i], (fy * y * inv + cy - xy[i, 1]) * inv_px[i]
        a, d = fx * inv * inv_px[i], fy * inv * inv_px[i]
        rz, e, limit = 0.0, 0.0, loss.pixel
        if depth[i] == depth[i]:
            rz, e, limit = (z - depth[i]) * inv_z[i], inv_z[i], loss.with_depth
        s = ru * ru + rv * rv + rz * rz
        chi2[i] = s
        if not is_used[i]:
            continue
        w = 1.0
        if robust and s > limit:
            w = np.sqrt(limit / s)
            cost += 2.0 * np.sqrt(limit * s) - limit
        else:
            cost += s
        c, f = -a * x * inv, -d * y * inv
        u3, u4, u5 = y * c, z * a - x * c, -y * a
        v3, v4, v5 = y * f - z * d, -x * f, x * d
        z3, z4 = y * e, -x * e
        ju, jv, jz = six(a, 0.0, c, u3, u4, u5), six(0.0, d, f, v3, v4, v5), six(0.0, 0.0, e, z3, z4, 0.0)
        wa, wc, wd, wf, we = w * a, w * c, w * d, w * f, w * e
        h0 = h0 + wa * ju
        h1 = h1 + wd * jv
        h2 = h2 + (wc * ju + wf * jv + we * jz)
        h3 = h3 + w * (u3 * ju + v3 * jv + z3 * jz)
        h4 = h4 + w * (u4 * ju + v4 * jv + z4 * jz)
        h5 = h5 + w * (u5 * ju + v5 * jv)
        b0 -= wa * ru
        b1 -= wd * rv
        b2 -= wc * ru + wf * rv + we * rz
        b3 -= w * (u3 * ru + v3 * rv + z3 * rz)
        b4 -= w * (u4 * ru + v4 * rv + z4 * rz)
        b5 -= w * (u5 * ru + v5 * rv)
    for i, h in enumerate((h0, h1, h2, h3, h4, h5)):
        store(H, i, h)
    b[0], b[1], b[2], b[3], b[4], b[5] = b0, b1, b2, b3, b4, b5
    return cost


@kernel(error_model="numpy")
def _rms(T, x_w, xy, camera, is_inlier):
    """Compute the root mean square reprojection error [px] of the inliers, NaN without any."""
    total, n = 0.0, 0
    for i in range(len(x_w)):
        if is_inlier[i]:
            z = T[2, 0] * x_w[i, 0] + T[2, 1] * x_w[i, 1] + T[2, 2] * x_w[i, 2] + T[2, 3]
            du = camera[0] * (T[0, 0] * x_w[i, 0] + T[0, 1] * x_w[i, 1] + T[0, 2] * x_w[i, 2] + T[0, 3]) / z + camera[2] - xy[i, 0]
            dv = camera[1] * (T[1, 0] * x_w[i, 0] + T[1, 1] * x_w[i, 1] + T[1, 2] * x_w[i, 2] + T[1, 3]) / z + camera[3] - xy[i, 1]
            total += du * du + dv * dv
            n += 1
    return np.sqrt(total / n)


@kernel(error_model="numpy")
def _usable(given, is_inlier):
    """Return what was measured with NaN for what is not finite; write which observations have all that they need."""
    n = len(given.x_w)
    seen = Seen(np.empty((n, 3)), given.xy, np.empty(n), given.inv_px, given.inv_z)
    for i in range(n):
        x, y, z, is_deep = given.x_w[i, 0], given.x_w[i, 1], given.x_w[i, 2], np.isfinite(given.inv_z[i]) and np.isfinite(given.depth[i])
        # A sum is finite when all its terms are.
        is_inlier[i] = np.isfinite(x + y + z + given.xy[i, 0] + given.xy[i, 1] + given.inv_px[i])
        for k in range(3):  # NaN is never in front of the camera: an outlier from the start
            seen.x_w[i, k] = given.x_w[i, k] if is_inlier[i] else np.nan
        seen.depth[i] = given.depth[i] if is_deep else np.nan
    return seen


@kernel(error_model="numpy")
def _expected_decrease(at, damping, step):
    """Return by how much a damped step lowers the cost, as the linearized problem foretells it."""
    expected = 0.0
    for i in range(6):
        expected += step[i] * (at.b[i] + damping * at.H[i, i] * step[i])
    return expected


@kernel(error_model="numpy")
def _sort_again(chi2, depth, loss, is_inlier):
    """Find the inliers anew; say whether any changed."""
    changed = False
    for i in range(len(chi2)):
        inside = chi2[i] <= (loss.with_depth if depth[i] == depth[i] else loss.pixel)
        if inside != is_inlier[i]:
            is_inlier[i] = inside
            changed = True
    return changed


@kernel(error_model="numpy")
def refine(T: f8[:, ::1], given: Seen, camera: f8[::1], loss: Huber, is_inlier: b1[::1]):
    """Refine T (4, 4) in place by Levenberg-Marquardt, with the inliers (N,) found anew after each round.

    given : as it was measured; camera : fx, fy, cx, cy [px]
    is_inlier : written; an observation with a value that is not finite is never one
    Returns the pose, its information (6, 6), the robust cost of the inliers, the iterations done, and the root
    mean square reprojection error [px] of the inliers, NaN without any.
    """
    n, seen = len(given.x_w), _usable(given, is_inlier)
    at, at_trial = System(np.empty((6, 6)), np.empty(6), np.empty(n)), System(np.empty((6, 6)), np.empty(6), np.empty(n))
    trial, step, L = np.empty((4, 4)), np.empty(6), np.empty((6, 6))
    total = 0
    cost = normal_equations(T, seen, is_inlier, camera, loss, at)
    for _ in range(ROUNDS):
        damping = DAMPING_START
        for _ in range(ITERATIONS):
            total += 1
            if not solve_damped(at.H, at.b, damping, L, step):
                damping *= 10.0
                if damping > DAMPING_MAX:
                    break
                continue
            if _expected_decrease(at, damping, step) <= 1e-9 * (1.0 + cost):
                break
            for i in range(4):  # trial[:, :] = T would take 6 s to compile, for the text of the error its shape check may raise
                for j in range(4):
                    trial[i, j] = T[i, j]
            left_update(trial, step)
            cost_trial = normal_equations(trial, seen, is_inlier, camera, loss, at_trial)
            if cost_trial < cost:
                cost = cost_trial
                T, trial, at, at_trial = trial, T, at_trial, at
                damping = max(DAMPING_MIN, 0.1 * damping)
            else:
                damping *= 10.0
                if damping > DAMPING_MAX:
                    break
        if not _sort_again(at.chi2, seen.depth, loss, is_inlier):
            break
        cost = normal_equations(T, seen, is_inlier, camera, loss, at)
    for i in range(6):
        for j in range(i):
            at.H[i, j] = at.H[j, i]
    return T, at.H, cost, total, _rms(T, seen.x_w, seen.xy, camera, is_inlier)
