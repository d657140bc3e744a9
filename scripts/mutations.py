#!/usr/bin/env python
"""Change the code in small ways and see whether the tests notice; what survives shows where they are blind.

    pip install cosmic-ray
    python scripts/mutations.py [MODULE ...] [--share 0.1] [--seed 0] [--timeout 180]

Modules are those of TESTS below. A copy of the checkout is mutated, never the checkout itself. Of all mutants of a module a share is
drawn; each runs the module's tests, which end at the first failure. Survivors are printed as diffs. Kernels are compiled anew where
their file is mutated, so a mutant takes 5 to 40 s.
"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# The tests that are about a module, quickest first.
TESTS = {
    "slam/key_frames": ["slam/test_key_frames.py"],
    "slam/tracker": ["slam/test_tracker.py", "slam/test_depth_tracking.py"],
    "slam/localizer": ["slam/test_tracker.py", "slam/test_depth_tracking.py"],
    "slam/map_growth": ["slam/test_map_growth.py"],
    "slam/loop_candidates": ["slam/test_loop_closing.py"],
    "slam/loop_verification": ["slam/test_loop_closing.py"],
    "slam/loop_pose_graph": ["slam/test_loop_closing.py", "slam/test_depth_tracking.py"],
    "slam/loop_closing": ["slam/test_loop_closing.py", "slam/test_map_segments.py"],
    "slam/map_merging": ["slam/test_map_segments.py"],
    "navigation/grid": ["navigation/test_grid.py", "navigation/test_grid_hazards.py"],
    "navigation/planner": ["navigation/test_planner.py"],
}
CONFIG = """
[cosmic-ray]
module-path = "slamcli/{module}.py"
timeout = {timeout}
excluded-modules = []
test-command = "{python} -m pytest -x -q -n 0 -p no:cacheprovider {tests}"

[cosmic-ray.distributor]
name = "local"
"""
# Nothing runs differently without a type, and a decorator taken off a kernel leaves the same function, only slower.
DULL_OPERATORS = ("core/ReplaceBinaryOperator_BitOr_", "core/RemoveDecorator")


def main() -> None:
    """Run a share of the mutants of some modules and print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(TESTS), metavar="MODULE")
    parser.add_argument("--share", type=float, default=0.1, help="of the mutants that are run")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=180.0, help="[s] after which a mutant counts as noticed")
    arguments = parser.parse_args()
    if unknown := set(arguments.modules) - set(TESTS):
        parser.error(f"no tests are named for {', '.join(sorted(unknown))}; known: {', '.join(TESTS)}")
    killed = total = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / ROOT.name
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", "runs", "__pycache__", ".venv", "site"))
        for module in arguments.modules:
            survivors, n = mutate(copy, module, share=arguments.share, rng=random.Random(arguments.seed), timeout=arguments.timeout)
            print(f"{module}: {n - len(survivors)} of {n} mutants noticed", flush=True)
            for diff in survivors:
                print(diff, flush=True)
            killed, total = killed + n - len(survivors), total + n
    print(f"{killed} of {total} mutants noticed")


def mutate(copy: Path, module: str, *, share: float, rng: random.Random, timeout: float) -> tuple[list[str], int]:
    """Run a share of a module's mutants; returns the diffs of those that no test noticed, and how many ran."""
    from cosmic_ray.work_db import WorkDB, use_db
    from cosmic_ray.work_item import TestOutcome

    tests = " ".join(f"tests/{name}" for name in TESTS[module])
    (copy / "mutants.toml").write_text(CONFIG.format(module=module, timeout=timeout, python=sys.executable, tests=tests))
    database = copy / "mutants.sqlite"
    database.unlink(missing_ok=True)
    cosmic_ray(copy, "baseline", "mutants.toml")
    cosmic_ray(copy, "init", "mutants.toml", "mutants.sqlite")
    with use_db(str(database), WorkDB.Mode.open) as work:
        items = sorted(
            (i for i in work.work_items if not i.mutations[0].operator_name.startswith(DULL_OPERATORS)),
            key=lambda i: i.mutations[0].start_pos,
        )
        chosen = rng.sample(items, max(1, round(share * len(items))))
        work.clear()
        work.add_work_items(chosen)
    cosmic_ray(copy, "exec", "mutants.toml", "mutants.sqlite")
    with use_db(str(database), WorkDB.Mode.open) as work:
        results = [result for _, result in work.results]
    return [str(result.diff) for result in results if result.test_outcome == TestOutcome.SURVIVED], len(results)


def cosmic_ray(copy: Path, *arguments: str) -> None:
    """Run cosmic-ray in the copy, whose package and tests are imported."""
    command = [sys.executable, "-m", "cosmic_ray.cli", *arguments]
    path = {"PYTHONPATH": f"{copy}:{copy / 'tests'}"}
    done = subprocess.run(command, cwd=copy, env={**os.environ, **path}, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"cosmic-ray {arguments[0]} failed: {done.stdout[-2000:]}{done.stderr[-2000:]}")


if __name__ == "__main__":
    main()
