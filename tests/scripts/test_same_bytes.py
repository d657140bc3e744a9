"""The same recording gives the same bytes whatever instructions the libraries may use; `scripts/same_bytes.py` does more of it."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

import same_bytes  # noqa: E402
from conftest import ROOM, ROOM_FRAMES  # noqa: E402

SIMULATE = f"""
import sys
from pathlib import Path
from slamcli.datasets import silent
from slamcli.datasets.simulate import simulate
simulate(Path(sys.argv[1]), progress=silent, **{ROOM})
"""

KERNELS = """
import hashlib, numpy as np
from slamcli.geometry import banded_cholesky, se3
from slamcli.geometry.algebra import eigh
rng = np.random.default_rng(1)
M = rng.normal(size=(60, 60))
M += M.T
upper = np.append((M + 60.0 * np.eye(60)).ravel(), np.zeros(60))
assert banded_cholesky.factorize(upper, 60, 60, 59, np.empty((6, 60)))
parts = [upper, se3.exp(rng.normal(size=(500, 6))), *eigh(M[:6, :6])]
print(hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest())
"""


def test_a_run_gives_the_same_bytes_with_other_instructions(room: Path, room_run: Path, tmp_path: Path) -> None:
    native, found = same_bytes.files(room_run), same_bytes.run(str(room), tmp_path, "old", same_bytes.Environment(same_bytes.OLD))
    assert list(found) == list(native)
    assert {stage: same_bytes.differing(found[stage], native[stage]) for stage in native} == {stage: [] for stage in native}


def test_a_simulated_recording_is_the_same_with_other_instructions(room: Path, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", SIMULATE, str(tmp_path / "room")], env={**os.environ, **same_bytes.OLD}, cwd=ROOT, check=True)
    names = sorted(path.relative_to(room) for path in room.rglob("*") if path.is_file())
    assert len(names) > 2 * ROOM_FRAMES
    assert [name for name in names if (room / name).read_bytes() != (tmp_path / "room" / name).read_bytes()] == []


def test_a_file_that_differs_or_is_missing_is_named() -> None:
    assert same_bytes.differing({"a": "1", "b": "2", "c": "3"}, {"a": "1", "b": "0", "d": "4"}) == ["b", "c", "d"]


def test_kernels_give_the_same_bytes_on_the_least_processor(tmp_path: Path) -> None:
    def digest(**variables: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", KERNELS], env={**os.environ, **variables}, cwd=ROOT, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    least = digest(NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="", NUMBA_CACHE_DIR=str(tmp_path))
    assert len(least) == len(hashlib.sha256().hexdigest())
    assert least == digest()
