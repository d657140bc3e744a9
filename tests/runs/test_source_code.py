"""A stage's sources: those it can reach, no others; a change in one of them makes its result stale and is named."""

import ast
import dataclasses
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from slamcli import files
from slamcli.config import options
from slamcli.runs import source_code
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

PACKAGE = source_code.PACKAGE
FILES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))


def forget() -> None:
    """Empty the caches that hold for the life of a process."""
    for function in vars(source_code).values():
        if hasattr(function, "cache_clear"):
            function.cache_clear()


@pytest.fixture
def edit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Append a text to a file of a copy of the package, which the module then looks at."""
    copy = shutil.copytree(PACKAGE, tmp_path / "slamcli", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(source_code, "PACKAGE", copy)
    forget()

    def edit(file: str, text: str = "\n# another state\n") -> None:
        with open(copy / file, "ab") as opened:
            opened.write(text.encode())
        forget()

    yield edit
    forget()


def parsed_imports(node: ast.AST) -> set[str]:
    """Every file of the package that import statements mention, by the parser; what only type checkers see is left out."""
    found: set[str] = set()
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        modules = []
        if isinstance(child, ast.Import):
            modules = [alias.name for alias in child.names]
        elif isinstance(child, ast.ImportFrom):
            modules = [str(child.module), *(f"{child.module}.{alias.name}" for alias in child.names)]
        for module in modules:
            if module.split(".")[0] == "slamcli":
                parts = module.split(".")[1:]
                names = ["/".join([*parts[:k], "__init__.py"]) for k in range(len(parts) + 1)] + ["/".join(parts) + ".py"]
                found |= {name for name in names if (PACKAGE / name).is_file()}
        found |= parsed_imports(child)
    return found


@pytest.mark.parametrize("file", FILES)
def test_the_text_is_read_as_the_parser_reads_it(file: str) -> None:
    assert source_code.imported(file) == parsed_imports(ast.parse((PACKAGE / file).read_text()))


def test_whatever_a_stage_loads_can_be_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source_code, "APART", frozenset())
    code = "import importlib, sys; importlib.import_module(sys.argv[1]); print(*(m for m in sys.modules if m.split('.')[0] == 'slamcli'))"
    for name in NAMES:
        command = [sys.executable, "-c", code, f"slamcli.stages.{name}"]
        modules = subprocess.run(command, capture_output=True, text=True, check=True, cwd=PACKAGE.parent, timeout=120).stdout.split()
        loaded = {file for module in modules for file in source_code._files_of(module)}
        assert loaded <= source_code.reachable([f"stages/{name}.py"]), name


def test_every_file_that_is_set_apart_exists_and_the_options_hold_no_code() -> None:
    assert set(FILES) >= source_code.APART
    classes = [value for value in vars(options).values() if dataclasses.is_dataclass(value) and value.__module__ == options.__name__]
    for section in classes:
        own = [name for name, value in vars(section).items() if callable(value) and not name.startswith("__")]
        assert not own, f"{section.__name__}: an option's class with methods computes something, so its file must count"


@pytest.mark.parametrize(
    ("file", "concerned", "unconcerned"),
    [
        ("slam/tracker.py", {"track"}, {"extract", "match", "densify", "octree", "grid2d"}),
        ("slam/loop_verification.py", {"loop"}, {"extract", "match", "densify", "octree", "grid2d"}),
        ("vision/quadtree.py", {"extract"}, {"match", "densify", "octree", "grid2d"}),
        ("data/vocabulary.npz", {"match"}, {"extract", "densify", "octree", "grid2d"}),
        ("stages/grid2d.py", {"grid2d"}, set(NAMES) - {"grid2d"}),
        ("cli/run.py", set(), set(NAMES)),
        ("report/page.py", set(), set(NAMES)),
        ("runs/pipeline.py", set(), set(NAMES)),
        ("datasets/simulated/room.py", set(), set(NAMES)),
        ("config/options.py", set(), set(NAMES)),
        ("datasets/recording.py", {"extract", "densify", "octree", "grid2d"}, {"match"}),
        ("datasets/readers/tum.py", {"extract", "densify", "octree", "grid2d"}, {"match", "track", "optimize", "loop"}),
        ("datasets/readers/replica.py", set(), set(NAMES)),
    ],
)
def test_a_change_concerns_the_stages_that_can_reach_the_file(edit, file: str, concerned: set[str], unconcerned: set[str]) -> None:
    before = {name: source_code.of_stage(name, "tum") for name in NAMES}
    edit(file)
    now = {name: source_code.of_stage(name, "tum") for name in NAMES}
    told = {name: source_code.changes(before[name], now[name]) for name in NAMES}
    stale = {name for name in NAMES if told[name]}
    assert stale >= concerned
    assert not stale & unconcerned
    assert all(told[name] == f"{file} changed" for name in stale)


def test_a_new_import_counts_from_then_on(edit) -> None:
    before = source_code.of_stage("grid2d")
    edit("navigation/grid.py", "\n\ndef late():\n    from slamcli.report import (  # here\n        page,\n    )\n")
    now = source_code.of_stage("grid2d")
    assert "report/page.py" in now.keys() - before.keys()
    assert source_code.changes(before, now).endswith("more changed")


def test_status_names_the_file_and_what_rests_on_the_stage(edit, room_run: Path, tmp_path: Path) -> None:
    run = RunDir(shutil.copytree(room_run, tmp_path / "run"))
    assert all(state.is_fresh for state in run.states().values())
    edit("navigation/planner.py")
    assert all(state.is_fresh for state in run.states().values())
    edit("slam/tracker.py")
    states = run.states()
    assert states["track"].reason == "code: slam/tracker.py changed"
    assert states["match"].is_fresh
    assert states["densify"].reason == "input: loop is stale"


def test_a_record_without_sources_is_stale_and_a_hostile_one_is_damage(room_run: Path, tmp_path: Path) -> None:
    run = RunDir(shutil.copytree(room_run, tmp_path / "run"))
    path = run.path / "match" / "stage.json"
    record = files.read_sealed(path)
    files.write_sealed(path, {**record, "code": {}})
    assert run.states()["match"].reason == "code: its sources were not recorded"
    for hostile in ({"code": ["stages/match.py"]}, {"reader": 3}):
        files.write_sealed(path, {**record, **hostile})
        assert run.states()["match"].state == "damaged"


def test_the_reader_of_the_recording_counts(edit, room_run: Path, tmp_path: Path) -> None:
    run = RunDir(shutil.copytree(room_run, tmp_path / "run"))
    assert run.record("extract")["reader"] == "tum" and run.record("match")["reader"] == ""
    edit("datasets/readers/replica.py")
    assert all(state.is_fresh for state in run.states().values())
    edit("datasets/readers/tum.py")
    assert run.states()["extract"].reason == "code: datasets/readers/tum.py changed"
