"""The whole program on a tiny simulated room: every promised file, a sound trajectory, the same bytes whatever happens on the way."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

import slamcli
from slamcli import mapped_memory
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

FILES = {
    "extract": {"frames.txt", "camera.json", "desc.npy"},
    "match": {"word.npy", "row.npy"},
    "track": {"trajectory.txt", "keyframes.txt", "T_wk.npy", "T_kc.npy"},
    "optimize": {"trajectory.txt", "keyframes.txt", "T_wk.npy"},
    "loop": {"trajectory.txt", "keyframes.txt", "posegraph.g2o", "T_wk.npy"},
    "densify": {"cloud.ply", "T_lw.npy"},
    "octree": {"map.ot", "map.bt"},
    "grid2d": {"map.pgm", "map.yaml", "p_occupied.npy"},
}


def digests(path: Path) -> dict[str, str]:
    return {name: record["digest"] for name in NAMES if (record := RunDir(path).record(name))}


def start(*arguments: str, **environment: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "slamcli", *arguments]
    elsewhere = Path(arguments[arguments.index("-r") + 1]).parent  # in the checkout it would be another copy than the one under test
    variables = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=variables, cwd=elsewhere)


def test_every_stage_leaves_its_files_and_is_up_to_date(room_run: Path, slamcli: Callable[..., Result]) -> None:
    rows = json.loads(slamcli("status", "-r", room_run, "--verify", "--json").stdout)
    assert {row["stage"]: row["state"] for row in rows} == dict.fromkeys(NAMES, "up to date")
    assert list(FILES) == list(NAMES)
    for stage, files in FILES.items():
        assert files <= set(os.listdir(room_run / stage)), stage


def test_the_trajectory_is_near_the_truth(room_run: Path, slamcli: Callable[..., Result]) -> None:
    ape = json.loads(slamcli("eval", "ape", "-r", room_run, "--json").stdout)
    assert 0.0001 < ape["rmse"] < 0.05
    assert ape["coverage"] > 0.9


def test_another_process_with_other_threads_and_hash_seed_gives_the_same_bytes(room: Path, room_run: Path, tmp_path: Path) -> None:
    process = start("run", str(room), "-r", str(tmp_path / "again"), "-s", "run.workers=1", PYTHONHASHSEED="7", OPENBLAS_NUM_THREADS="1")
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert digests(tmp_path / "again") == digests(room_run)


def test_memory_that_is_let_go_all_the_time_gives_the_same_bytes(
    room: Path, room_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No stage writes to what it was given, and none relies on where its large arrays lie."""
    monkeypatch.setattr(mapped_memory, "MOST_RESIDENT", 0)
    monkeypatch.setattr(mapped_memory, "LEAST_FILE", 1)
    monkeypatch.setattr(mapped_memory, "LOOK", 0.001)
    again = slamcli.run(room, path=tmp_path / "again")
    assert digests(again.path) == digests(room_run)


@pytest.mark.parametrize("stage", NAMES)
def test_killed_for_real_in_a_stage_then_run_again_gives_the_same_bytes(room_run: Path, tmp_path: Path, stage: str) -> None:
    path = tmp_path / "run"
    shutil.copytree(room_run, path)
    process = start("run", "-r", str(path), "--from", stage)
    deadline = time.monotonic() + 120
    try:
        while process.poll() is None and not list(path.glob(f".{stage}.*")) and time.monotonic() < deadline:
            time.sleep(0.002)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == -9
    again = start("run", "-r", str(path))
    _, said = again.communicate(timeout=300)
    assert again.returncode == 0, said
    assert digests(path) == digests(room_run)
    assert not list(path.glob(".*.*"))
