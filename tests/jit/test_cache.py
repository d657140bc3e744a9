"""Compiled kernels are kept in a folder of our own; nothing else of the process is touched."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slamcli.jit import cache

PACKAGE = Path(cache.__file__).parents[1]
HELPER = '''"""A kernel and its caller."""

import os, sys

import numba

from slamcli.jit import cache
from slamcli.jit.kernel import kernel


@kernel
def twice(x):
    return 2 * x


@numba.njit(cache=True)
def foreign(x):
    return x + 1


assert twice(2.0) == 4.0
assert foreign(1.0) == 2.0
print(cache.folder())
print(sum(twice.stats.cache_hits.values()), sum(twice.stats.cache_misses.values()))
'''


CALLER = """
from records import Record

from slamcli.jit.kernel import kernel


@kernel
def difference(pair):
    return pair.first - pair.second


print(difference(Record(first=5.0, second=2.0)))
"""


def difference(folder: Path, name: str, *fields: str) -> float:
    """Call a kernel, in a process of its own, whose argument is a record of another file."""
    lines = [f"class {name}(NamedTuple):", *(f"    {field}: float" for field in fields)]
    (folder / "records.py").write_text("from typing import NamedTuple\n\n" + "\n".join(lines) + f"\n\n\nRecord = {name}\n")
    (folder / "caller.py").write_text(CALLER)
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent), "NUMBA_CACHE_DIR": str(folder / "kept"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "caller.py"], cwd=folder, env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    return float(done.stdout)


def run_helper(folder: Path, **environment: str) -> tuple[Path, int, int]:
    """Run the helper in a process of its own; gives the cache's folder, hits and misses."""
    (folder / "helper.py").write_text(HELPER)
    inherited = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    environment = {**inherited, "PYTHONPATH": str(PACKAGE.parent), **environment}
    done = subprocess.run(
        [sys.executable, "helper.py"], cwd=folder, env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    place, counts = done.stdout.splitlines()
    return Path(place), *map(int, counts.split())


def test_a_kernel_is_loaded_from_our_folder_in_the_next_process_and_foreign_kernels_are_kept_elsewhere(tmp_path: Path) -> None:
    home = tmp_path / "cache"
    place, hits, misses = run_helper(tmp_path, XDG_CACHE_HOME=str(home))
    assert (hits, misses) == (0, 1)
    assert place.parent == home / "slamcli"
    kept = [path.name for path in place.rglob("*.nbc")]
    assert len(kept) == 1 and kept[0].startswith("helper.twice")
    assert run_helper(tmp_path, XDG_CACHE_HOME=str(home)) == (place, 1, 0)


def test_another_source_makes_machine_code_stale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = str(tmp_path / "cache")
    run_helper(tmp_path, XDG_CACHE_HOME=home)
    changed = HELPER.replace("return 2 * x", "return x * 2")
    monkeypatch.setitem(globals(), "HELPER", changed)
    assert run_helper(tmp_path, XDG_CACHE_HOME=home)[1:] == (0, 1)


def test_a_record_of_another_file_whose_fields_change_places_makes_machine_code_stale(tmp_path: Path) -> None:
    assert difference(tmp_path, "Pair", "first", "second") == 3.0
    assert difference(tmp_path, "Pair", "second", "first") == 3.0


def test_what_was_kept_for_a_record_that_is_no_more_is_not_there(tmp_path: Path) -> None:
    assert difference(tmp_path, "Pair", "first", "second") == 3.0
    assert difference(tmp_path, "Both", "first", "second") == 3.0
    for kept in (tmp_path / "kept").rglob("*.nb[ic]"):
        kept.write_bytes(kept.read_bytes()[:-7])
    assert difference(tmp_path, "Both", "first", "second") == 3.0


def test_the_user_may_name_the_folder_as_for_any_numba_program(tmp_path: Path) -> None:
    place, *_ = run_helper(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "numba"))
    assert place.parent == tmp_path / "numba"


def test_without_a_writable_home_a_temporary_folder_serves_this_process(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("no folder can be made below a file")
    place, hits, misses = run_helper(tmp_path, XDG_CACHE_HOME=str(blocked), TMPDIR=str(tmp_path))
    assert (hits, misses) == (0, 1)
    assert place.parent.parent == tmp_path and place.parent.name.startswith("slamcli-kernels-")
    assert not place.exists(), "it goes with the process"


def test_importing_slamcli_makes_no_folder_sets_no_variable_and_loads_nothing_heavy(tmp_path: Path) -> None:
    code = (
        "import os, sys; before = dict(os.environ); import slamcli; assert dict(os.environ) == before;"
        "print(*(m for m in sys.modules if m.split('.')[0] in {'numpy', 'numba', 'cv2', 'click', 'tqdm', 'logging', 'dataclasses'}))"
    )
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == ""
    assert not (tmp_path / "cache").exists()
