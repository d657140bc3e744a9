"""Kernels are compiled once, before their first use, and a run then compiles nothing more."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from test_files import largest_file

from slamcli.jit import cache, compilation
from slamcli.jit.kernel import argument_types

WATCHED_RUN = """
import sys
from numba.core import event
from slamcli.cli.main import cli

class Watch(event.Listener):
    def on_start(self, found):
        function = found.data["dispatcher"].py_func
        print("compiled", function.__module__, function.__qualname__)
    def on_end(self, found):
        pass

watch = Watch()
event.register("numba:compile", watch)
cli(sys.argv[1:])
"""


def test_a_run_compiles_nothing_that_was_not_compiled_before_it(room: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", WATCHED_RUN, "run", str(room), "-r", str(tmp_path / "run")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}  # this copy, from wherever
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300, cwd=tmp_path, env=environment)
    assert "grid2d" in done.stderr
    assert "compiled" not in done.stdout


def test_every_process_takes_its_share_and_together_they_take_all() -> None:
    kernels = compilation.declared()
    shares = [kernels[share::3] for share in range(3)]
    assert {id(k) for share in shares for k in share} == {id(k) for k in kernels}
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert all(len(argument_types(k)) == k.py_func.__code__.co_argcount for k in kernels)


def test_what_is_compiled_is_not_compiled_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = []
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "kernels")
    monkeypatch.setattr(compilation, "compile_all", lambda processes: calls.append(processes) or iter(("one", "two")))
    compilation.ensure()
    compilation.ensure()
    assert len(calls) == 1
    assert 1 <= calls[0] <= (os.cpu_count() or 1)


def test_other_sources_are_compiled_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    calls = []
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "kernels")
    monkeypatch.setattr(compilation, "compile_all", lambda processes: calls.append(processes) or iter(()))
    compilation.ensure()
    monkeypatch.setattr(compilation, "PACKAGES", ("geometry",))
    compilation.ensure()
    assert len(calls) == 2


def test_the_processes_compile_this_package_and_not_one_that_lies_in_the_current_folder(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "slamcli").mkdir()
    (here / "slamcli" / "__init__.py").write_text("")
    monkeypatch.setattr(compilation, "CHILD", "import slamcli; print(slamcli.__file__)")
    assert list(compilation.compile_all(1)) == [str(Path(compilation.__file__).parents[1] / "__init__.py")]


def test_an_interruption_ends_the_processes_that_compile(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(
        compilation,
        "CHILD",
        f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); print(1, flush=True); time.sleep(60)",
    )
    names = compilation.compile_all(1)
    assert next(names) == "1"
    pid = int((tmp_path / "pid").read_text())
    names.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_the_processes_really_compile_and_leave_their_kernels_in_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "kernels")
    one = "import sys; from slamcli.jit import compilation; compilation.PACKAGES = ('geometry',); compilation.compile_share(20, 21)"
    monkeypatch.setattr(compilation, "CHILD", one)
    names = list(compilation.compile_all(1))
    assert names
    assert len(list(tmp_path.rglob("*.nbc"))) >= len(names)


def test_a_process_compiles_its_share_and_names_it() -> None:
    home = Path(compilation.__file__).parents[2]
    command = [sys.executable, "-c", compilation.CHILD, "0", str(len(compilation.declared()))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=home)
    assert done.returncode == 0, done.stderr
    (name,) = done.stdout.split()
    assert name in {kernel.py_func.__qualname__ for kernel in compilation.declared()}


def test_a_full_folder_is_told_and_not_taken_for_a_finished_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "kernels")
    one = "import sys; from slamcli.jit import compilation; compilation.PACKAGES = ('geometry',); compilation.compile_share(20, 21)"
    monkeypatch.setattr(compilation, "CHILD", one)
    with largest_file(500):
        compilation.ensure()
    assert "kernels: not every kernel could be kept there" in caplog.text
    assert not list(tmp_path.rglob("compiled-*"))
    compilation.ensure()
    assert len(list(tmp_path.rglob("compiled-*"))) == 1
