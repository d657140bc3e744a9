#!/usr/bin/env python
"""Change the code in small ways and see whether the tests notice; what survives shows where they are blind.

    pip install cosmic-ray
    python scripts/mutations.py [MODULE ...] [--number 40] [--seed 0] [--only K ...]

Modules are those of TESTS below. A copy of the checkout is mutated, never the checkout itself. Of a module's mutants, made by
cosmic-ray's operators, some are drawn, at as many places of it as can be. Each runs the module's tests, the quickest first, up to the
first that fails, in a process forked (Unix only) from one that has imported all that does not depend on the module: half a second where a
test soon notices. Survivors are printed as diffs.
"""

import argparse
import ast
import difflib
import functools
import importlib
import itertools
import os
import pkgutil
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TRACKING = ["slam/test_tracker.py", "slam/test_depth_tracking.py", "options/test_tracking_options.py"]
LOOPS = ["slam/test_loop_closing.py", "options/test_loop_options.py"]
TESTS = {  # that are about a module
    "slam/key_frames": ["slam/test_key_frames.py"],
    "slam/tracker": ["slam/test_tracking_decisions.py", *TRACKING, "slam/test_map_segments.py", "slam/test_rests.py"],
    "slam/localizer": ["slam/test_tracking_decisions.py", *TRACKING, "slam/test_map_segments.py"],
    "slam/map_growth": ["slam/test_map_growth.py", "slam/test_tracker.py", "options/test_tracking_options.py"],
    "slam/loop_candidates": ["slam/test_loop_candidates.py", *LOOPS],
    "slam/loop_verification": LOOPS,
    "slam/loop_pose_graph": ["slam/test_loop_pose_graph.py", "slam/test_loop_closing.py"],
    "slam/loop_closing": ["slam/test_loop_rounds.py", "slam/test_loop_closing.py", "slam/test_map_segments.py"],
    "slam/map_merging": ["slam/test_map_segments.py", "options/test_loop_options.py"],
    "navigation/grid": ["navigation/test_grid_fusion.py", "navigation/test_grid.py", "navigation/test_grid_hazards.py"],
    "navigation/planner": ["navigation/test_planner.py"],
    "slam/background_prior": ["slam/test_background_prior.py"],
    "slam/moving_objects": ["slam/test_moving_objects.py"],
    "slam/pose_doubt": ["slam/test_pose_doubt.py"],
    "slam/doubt": ["slam/test_doubt.py", "slam/test_pose_doubt.py"],
    "evaluation/map_verdict": ["evaluation/test_verdict_limits.py", "evaluation/test_map_verdict.py"],
}
SLOWER = 6.0  # times as long as unchanged code, beyond COMPILING, may a mutant take; then it counts as noticed
COMPILING = 60.0  # [s]


@dataclass(frozen=True)
class Change:
    """What one of cosmic-ray's operators does at one place of a source."""

    operator: str
    number: int  # of the place, among those that the operator finds
    place: tuple  # start and end of what is changed

    @property
    def line(self) -> int:
        """Return the line, from 1."""
        return int(self.place[0][0])

    def applied(self, source: str) -> str:
        """Return the source with the change; the source itself where the operator changes nothing there."""
        import cosmic_ray.plugins
        from cosmic_ray.mutating import mutate_code

        return mutate_code(source, cosmic_ray.plugins.get_operator(self.operator)(), self.number) or source


def main() -> None:
    """Run some mutants of some modules and print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=list(TESTS), metavar="MODULE")
    parser.add_argument("--number", type=int, default=40, help="of mutants that are run of each module [40]")
    parser.add_argument("--only", type=int, nargs="+", metavar="K", help="run these again: their numbers, printed with the survivors")
    parser.add_argument("--seed", type=int, default=0, help="of the draw [0]")
    parser.add_argument("--folder", type=Path, help="of the copy, kept: the next run finds its kernels compiled [a temporary one]")
    arguments = parser.parse_args()
    if unknown := set(arguments.modules) - set(TESTS):
        parser.error(f"no tests are named for {', '.join(sorted(unknown))}; known: {', '.join(TESTS)}")
    with tempfile.TemporaryDirectory() as folder:
        copy = (arguments.folder or Path(folder)) / ROOT.name
        ignored = shutil.ignore_patterns(".git", "runs", "__pycache__", ".venv", "site")
        shutil.copytree(ROOT, copy, ignore=ignored, dirs_exist_ok=True)
        for module in arguments.modules:
            # A process of its own, as what is imported depends on the module.
            in_fork(functools.partial(try_module, copy, module, arguments), log=None)


def try_module(copy: Path, module: str, arguments: argparse.Namespace) -> None:
    """Run mutants of one module; print how many the tests noticed, and the diffs of the others."""
    os.chdir(copy)
    sys.dont_write_bytecode = True  # of one mutant it could be read for the next
    sys.path[:0] = [str(copy), str(copy / "tests")]
    file = copy / f"slamcli/{module}.py"
    original = (ROOT / f"slamcli/{module}.py").read_text()
    import_all_but(f"slamcli.{module.replace('/', '.')}")
    order, log = copy / "order.txt", copy / "log.txt"
    started = time.monotonic()
    if not in_fork(lambda: run_tests([f"tests/{name}" for name in TESTS[module]], order), log=log):
        sys.exit(f"{module}: the tests fail without any mutation: see {log}" if arguments.folder else log.read_text())
    timeout = COMPILING + SLOWER * (time.monotonic() - started)
    drawn = draw(original, random.Random(arguments.seed))
    tried = survivors = 0
    for number in arguments.only or range(len(drawn)):
        mutated = drawn[number].applied(original)
        if mutated == original:
            continue
        file.write_text(mutated)
        try:
            survived = in_fork(functools.partial(run_mutant, drawn[number], original, order), log=log, timeout=timeout)
        finally:
            file.write_text(original)
        if survived:
            survivors += 1
            diff = difflib.unified_diff(original.splitlines(), mutated.splitlines(), module, module, n=0, lineterm="")
            print("\n".join([f"{number}:", *itertools.islice(diff, 2, None)]), flush=True)
        tried += 1
        if tried == arguments.number:
            break
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = (spent.ru_utime + spent.ru_stime) / max(tried, 1)
    print(f"{module}: {tried - survivors} of {tried} mutants noticed, {seconds:.1f} s of CPU time each", flush=True)


def draw(source: str, rng: random.Random) -> list[Change]:
    """Shuffle all changes so that each place is changed once before any is changed twice."""
    changes = list(all_changes(source))
    rng.shuffle(changes)
    seen: dict[tuple, int] = {}
    turn = []
    for change in changes:
        turn.append(seen.get(change.place, 0))
        seen[change.place] = turn[-1] + 1
    return [changes[k] for k in sorted(range(len(changes)), key=lambda k: turn[k])]


def all_changes(source: str) -> Iterator[Change]:
    """Yield the changes of a source, but for those that cannot make it behave differently."""
    import cosmic_ray.plugins
    from cosmic_ray.ast import ast_nodes, get_ast

    dull, signatures = where_types_stand(source), where_arguments_stand(source)
    nodes = list(ast_nodes(get_ast(source)))
    for name in cosmic_ray.plugins.operator_names():
        kind = cosmic_ray.plugins.get_operator(name)
        if kind.arguments() or name == "core/RemoveDecorator":
            continue
        skipped = dull + signatures if "BinaryOperator" in name else dull
        for k, place in enumerate(position for node in nodes for position in kind().mutation_positions(node)):
            if not any(a <= place[0] < b for a, b in skipped):
                yield Change(name, k, place)


def where_arguments_stand(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """List where functions name their arguments: the star before those given by keyword is no product."""
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    return [((n.lineno, n.col_offset), (n.body[0].lineno, n.body[0].col_offset)) for n in functions]


def where_types_stand(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """List where annotations and decorators stand: nothing runs differently without a type, nor with records that can be changed."""
    nodes: list[ast.AST | None] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg | ast.AnnAssign):
            nodes.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            nodes += [node.returns, *node.decorator_list]
        elif isinstance(node, ast.ClassDef):
            nodes += node.decorator_list
    return [((n.lineno, n.col_offset), (n.end_lineno, n.end_col_offset)) for n in nodes if n is not None]  # type: ignore[attr-defined]


def import_all_but(module: str) -> None:
    """Import every module of the package that can do without `module`, and load the machine code of its kernels."""
    import slamcli
    from slamcli.jit import cache, compilation
    from slamcli.jit.kernel import DECLARED, argument_types

    for name in ("_pytest.config", "pytest", "hypothesis", "click.testing", "scipy.ndimage", "cv2"):
        importlib.import_module(name)
    compilation.ensure()
    compilation.ensure = lambda **_: None  # tests would look through all kernels again
    sys.modules[module] = None  # type: ignore[assignment]  # an import of it fails, and so does what needs it
    for found in pkgutil.walk_packages(slamcli.__path__, "slamcli."):
        if not found.name.endswith("__main__"):
            try:
                importlib.import_module(found.name)
            except ImportError:
                continue
    del sys.modules[module]
    for compiled in DECLARED:
        compiled.compile(argument_types(compiled))
    cache._digest(str(Path(f"{module.replace('.', '/')}.py").absolute()))  # mutants outside kernels find these compiled


def run_mutant(change: Change, original: str, order: Path) -> None:
    """Run the tests of a mutant whose file is in place, in the order noted."""
    from slamcli.jit import cache

    if is_in_kernel(original, change.line):
        cache._digest.cache_clear()
        cache.KernelCache.save_overload = lambda *_: None  # type: ignore[method-assign]
    run_tests(order.read_text().splitlines())


def is_in_kernel(source: str, line: int) -> bool:
    """Say whether a line is one that numba compiles, or a constant outside of functions, which it compiles in."""
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    around = [n for n in functions if n.lineno <= line <= (n.end_lineno or line)]
    return not around or any("kernel" in ast.unparse(d) for n in around for d in n.decorator_list)


class Stopwatch:
    """Notes how long each test takes."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def pytest_runtest_logreport(self, report) -> None:  # pytest's own record
        """Add up a test's set-up and call."""
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration


def run_tests(names: list[str], order: Path | None = None) -> None:
    """Run tests up to the first that fails and end the process with pytest's status; note their names in `order`, the quickest first."""
    import pytest

    watch = Stopwatch()
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    status = pytest.main(["-x", "-q", "-o", "addopts=", "-p", "no:cacheprovider", *names], plugins=[watch])
    if order is not None:
        order.write_text("\n".join(sorted(watch.seconds, key=watch.seconds.__getitem__)))
    os._exit(int(status))


def in_fork(task: Callable[[], None], *, log: Path | None, timeout: float = 1e6) -> bool:
    """Run a task in a child process; say whether it ended well, and in time [s]. Its output goes to `log`."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        try:
            if log is not None:
                os.setsid()
                output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                os.dup2(output, 1), os.dup2(output, 2)
            task()
            sys.stdout.flush()
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", flush=True)
            os._exit(1)
        os._exit(0)
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if (done := os.waitpid(child, os.WNOHANG))[0]:
            return os.waitstatus_to_exitcode(done[1]) == 0
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


if __name__ == "__main__":
    main()
