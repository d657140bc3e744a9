#!/usr/bin/env python
"""Bundle adjustment against g2o on the same problems: final cost, and time per iteration.

    python scripts/bundle_vs_g2o.py [--seed N] [--small]

Both start from the same poses and landmarks and minimize the same sum of Huber costs over pixels and depths. Times are CPU time of one
thread; g2o's are of its own `optimize`, without the time to build the graph; ours are given without and with building the problem.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from slamcli.estimation import bundle_adjustment
from slamcli.estimation.bundle_problem import Observations, Problem, Variables
from slamcli.estimation.robust_loss import HUBER
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.parallel import one_thread_in_blas

CAMERA = Camera(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
SEEN_BY, AMONG = 6, 8  # key frames that observe a landmark, of so many that could


def drive(n_kf: int, n_lm: int, seed: int) -> tuple:
    """A camera driving past a wall of landmarks, each observed by 6 key frames; 3 % of the observations are wrong."""
    rng = np.random.default_rng(seed)
    step = 0.12
    T_true = se3.exp(np.column_stack([-step * np.arange(n_kf), 0.05 * rng.normal(size=(n_kf, 2)), 0.03 * rng.normal(size=(n_kf, 3))]))
    first = np.sort(rng.integers(0, n_kf - AMONG + 1, n_lm))
    centre = step * (first + 0.5 * AMONG)
    x_true = np.column_stack([centre + rng.uniform(-0.5, 0.5, n_lm), rng.uniform(-0.7, 0.7, n_lm), rng.uniform(1.8, 5.0, n_lm)])
    obs_lm = np.repeat(np.arange(n_lm), SEEN_BY)
    obs_kf = np.sort(first[:, None] + np.argsort(rng.random((n_lm, AMONG)), axis=1)[:, :SEEN_BY], axis=1).ravel()
    x_c = np.einsum("oij,oj->oi", T_true[obs_kf, :3, :3], x_true[obs_lm]) + T_true[obs_kf, :3, 3]
    z = x_c[:, 2]
    sigma_px, sigma_z = 1.2 ** rng.integers(0, 5, len(z)), 0.0012 + 0.0019 * (z - 0.4) ** 2
    xy = CAMERA.project(x_c) + sigma_px[:, None] * rng.normal(size=(len(z), 2))
    wrong = rng.random(len(z)) < 0.03
    xy[wrong] += rng.uniform(-30, 30, (wrong.sum(), 2))
    depth = np.where(z < 4.0, z + sigma_z * rng.normal(size=len(z)), np.nan)
    error = rng.normal(size=(n_kf, 6)) * [0.02, 0.02, 0.02, 0.01, 0.01, 0.01]
    error[0] = 0.0
    x_w = x_true + 0.03 * rng.normal(size=x_true.shape)
    seen = Observations(obs_kf, obs_lm, xy, depth, sigma_px, sigma_z)
    return se3.exp(error) @ T_true, x_w, seen, CAMERA


def cpu_ms(function) -> float:
    """Return the CPU time [ms] of a call."""
    start = time.process_time()
    function()
    return 1e3 * (time.process_time() - start)


def compare(n_kf: int, n_lm: int, seed: int, *, repeats: int, iterations: int = 10) -> None:
    """Print one comparison."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))  # the same oracle as the tests use
    from g2o_bundle import G2oBundle

    given = drive(n_kf, n_lm, seed)
    is_fixed = np.arange(n_kf) == 0
    print(f"{n_kf} key frames, {n_lm} landmarks, {len(given[2])} observations")
    with tempfile.TemporaryDirectory() as folder:

        def build() -> G2oBundle:
            return G2oBundle(*given, is_fixed=is_fixed, limits=HUBER, folder=Path(folder))

        def problem() -> Problem:
            T_cw, x_w, seen, camera = given
            return Problem(Variables(T_cw, x_w), seen, camera, is_fixed=is_fixed)

        prepared = problem()
        short = bundle_adjustment.adjust(prepared, max_iterations=iterations, tolerance=0.0)  # compiles
        g2o_ms = loop_ms = total_ms = built_ms = np.inf
        for _ in range(repeats):  # in turn, so that what else the machine does meets both
            peer = build()
            start = peer.cost()
            g2o_ms = min(g2o_ms, cpu_ms(lambda peer=peer: peer.optimize(iterations)) / iterations)
            after = peer.cost()
            loop_ms = min(loop_ms, cpu_ms(lambda: bundle_adjustment.minimize(prepared, max_iterations=iterations, tolerance=0.0)))
            built_ms = min(built_ms, cpu_ms(problem))
            total_ms = min(total_ms, cpu_ms(lambda: bundle_adjustment.adjust(problem(), max_iterations=iterations, tolerance=0.0)))
        for _ in range(60):
            before = peer.cost()
            peer.optimize(10)
            if before - peer.cost() <= 1e-9 * before:
                break
        g2o_cost = peer.cost()
    final = bundle_adjustment.adjust(prepared, max_iterations=100, tolerance=1e-12)
    print(f"  cost at the start         ours {short.cost[0]:.6f}  g2o {start:.6f}  difference {short.cost[0] / start - 1:+.1e}")
    print(f"  cost after {iterations} iterations  ours {short.cost[-1]:.6f}  g2o {after:.6f}")
    print(f"  cost at the end           ours {final.cost[-1]:.6f}  g2o {g2o_cost:.6f}  difference {final.cost[-1] / g2o_cost - 1:+.1e}")
    ours_ms = loop_ms / short.iterations
    print(f"  CPU time per iteration    ours {ours_ms:.2f} ms  g2o {g2o_ms:.2f} ms  ratio {g2o_ms / ours_ms:.1f}")
    print(f"  {iterations} iterations, all in     ours {total_ms:.1f} ms, of which {built_ms:.1f} ms for building the problem\n")


def main() -> None:
    """Compare on the two problems."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--small", action="store_true", help="the 12 key frames only")
    arguments = parser.parse_args()
    with one_thread_in_blas():
        compare(12, 2000, arguments.seed, repeats=10)
        if not arguments.small:
            compare(150, 20000, arguments.seed, repeats=3)


if __name__ == "__main__":
    main()
