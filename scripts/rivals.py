"""Other systems on the images of a run of ours, each in a process of its own, and their figures."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from slamcli.errors import SlamError
from slamcli.evaluation import run_trajectories, trajectory_error
from slamcli.formats.trajectory import read_tum
from slamcli.runs.run_directory import RunDir

HERE = Path(__file__).parent


def orbslam3(run: RunDir, python: str, words: str) -> dict[str, Any]:
    """Let ORB-SLAM3 track: the interpreter of an environment that has it, and its vocabulary; see orbslam3.py."""
    return figures(run, [python, str(HERE / "orbslam3.py"), words], run.path / "orbslam3.txt")


def open3d(run: RunDir) -> dict[str, Any]:
    """Let Open3D's dense RGB-D SLAM track; see open3d_slam.py."""
    return figures(run, [sys.executable, str(HERE / "open3d_slam.py")], run.path / "open3d.txt")


def figures(run: RunDir, command: list[str], out: Path) -> dict[str, Any]:
    """Run a command that writes a trajectory to `out`: CPU time without decoding [ms a frame], wall time [s], memory [MiB], APE, coverage."""
    process = subprocess.Popen([*command, str(run.path), "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    said = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SlamError(f"{' '.join(command)} ended with status {process.returncode}")
    told = json.loads(said.splitlines()[-1])
    cpu = told["cpu_seconds"] - told["decode_cpu_seconds"]
    all_cpu = 1e3 * told["cpu_seconds"] / n_frames(run)
    found = {
        "cpu_ms": 1e3 * cpu / n_frames(run),
        "cpu_with_decoding_ms": all_cpu,
        "wall_seconds": told["wall_seconds"],
        "peak_mib": used.ru_maxrss / 2**10,
    }
    return {**found, **(accuracy(run, read_tum(out)) if told["tracked"] else {"ape": None, "coverage": 0.0})}


def accuracy(run: RunDir, found: Any) -> dict[str, Any]:
    """Return APE [m], None where no pose can be compared, and the share of colour frames with a pose."""
    coverage = len(found.stamp) / n_frames(run)
    try:
        error = trajectory_error.ape(found, run_trajectories.ground_truth(run), n_frames=n_frames(run), name=str(run.path)).error
    except SlamError:
        return {"ape": None, "coverage": coverage}
    return {"ape": trajectory_error.rmse(error), "coverage": coverage}


def n_frames(run: RunDir) -> int:
    """Return the number of colour frames."""
    return int(run.record("extract")["summary"]["frames"])
