"""Are the bytes of a run the same on another processor? Run recordings under other instruction sets and compare every file.

    python scripts/same_bytes.py demo path/to/recording --only blas numpy --out /tmp/bytes
    python scripts/same_bytes.py demo --python 3.12=/path/to/venv/bin/python

Libraries choose their code by the processor they find; variables of the environment let them find less. What is set is told in
ENVIRONMENTS. A row a stage says `same`, or the files that differ from those of the first environment, `native`.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from slamcli.stages import NAMES

ROOT = Path(__file__).parents[1]
Files = dict[str, dict[str, str]]  # sha256 of the files of each stage


@dataclass(frozen=True)
class Environment:
    """Variables that make libraries believe in another processor, and how Python is started."""

    variables: dict[str, str] = field(default_factory=dict)
    cores: str = ""  # of taskset, all where empty


OLD_NUMPY = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
OLD_LIBC = "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F,-AVX512VL"
OLD_OPENCV = "AVX512-SKX,AVX2,FMA3,AVX,FP16,SSE4.2,SSE4.1"
OLD = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": OLD_NUMPY, "GLIBC_TUNABLES": OLD_LIBC} | {
    "OPENCV_CPU_DISABLE": OLD_OPENCV,
    "OPENCV_IPP": "sse42",
}
ENVIRONMENTS = {
    "native": Environment(),
    "blas-nehalem": Environment({"OPENBLAS_CORETYPE": "Nehalem"}),
    "blas-haswell": Environment({"OPENBLAS_CORETYPE": "Haswell"}),
    "numpy-v3": Environment({"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}),
    "numpy-v2": Environment({"NPY_DISABLE_CPU_FEATURES": OLD_NUMPY}),
    "libc-sse": Environment({"GLIBC_TUNABLES": OLD_LIBC}),
    "opencv-sse": Environment({"OPENCV_CPU_DISABLE": OLD_OPENCV}),
    "ipp-sse42": Environment({"OPENCV_IPP": "sse42"}),
    "ipp-off": Environment({"OPENCV_IPP": "disabled"}),
    "one-core": Environment(cores="0"),
    "numba-generic": Environment({"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}),
    "numba-haswell": Environment({"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}),
    "all-old": Environment({**OLD, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}, cores="0"),
}


def run(
    recording: str, out: Path, name: str, environment: Environment, *, python: str = sys.executable, settings: Sequence[str] = ()
) -> Files:
    """Run a recording; give the sha256 of each file of each stage. A run that is there already is only brought up to date."""
    variables = {**os.environ, **environment.variables, "PYTHONPATH": str(ROOT)}
    if "NUMBA_CPU_NAME" in environment.variables:  # machine code of another target is compiled apart, in minutes
        variables["NUMBA_CACHE_DIR"] = str(out / f"kernels-{environment.variables['NUMBA_CPU_NAME']}")
    folder = out / Path(recording).name / name
    command = ["taskset", "-c", environment.cores] if environment.cores else []
    command += [python, "-m", "slamcli", "run", recording, "-r", str(folder), *(part for s in settings for part in ("-s", s))]
    done = subprocess.run(command, env=variables, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr}")
    return files(folder)


def files(run_folder: Path) -> Files:
    """Read the sha256 of each file of each stage from the records of a run."""
    records = [json.loads(path.read_text()) for path in run_folder.glob("*/stage.json")]
    found = {record["stage"]: {file: entry["sha256"] for file, entry in record["outputs"].items()} for record in records}
    return {stage: found[stage] for stage in NAMES if stage in found}


def differing(found: dict[str, str], native: dict[str, str]) -> list[str]:
    """List the files that differ or are missing on one side."""
    return sorted(file for file in found.keys() | native.keys() if found.get(file) != native.get(file))


def main() -> None:
    """Run each recording under each environment and print what differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--only", nargs="+", default=list(ENVIRONMENTS), help="environments, by the beginnings of their names")
    parser.add_argument("--python", action="append", default=[], metavar="NAME=PATH", help="another interpreter, as a further environment")
    parser.add_argument("--out", type=Path, default=Path("/tmp/same_bytes"), help="folder of the runs and of their kernels")
    parser.add_argument("-s", "--set", action="append", default=[], dest="settings", help="setting of the runs")
    arguments = parser.parse_args()
    rows = {name: (e, sys.executable) for name, e in ENVIRONMENTS.items() if name == "native" or name.startswith(tuple(arguments.only))}
    rows |= {name: (Environment(), path) for name, _, path in (item.partition("=") for item in arguments.python)}
    n_different = 0
    for recording in arguments.recordings:
        native: Files = {}
        for name, (environment, python) in rows.items():
            found = run(recording, arguments.out, name, environment, python=python, settings=arguments.settings)
            native = native or found
            told = {stage: differing(found[stage], native[stage]) for stage in found}
            n_different += sum(map(bool, told.values()))
            row = "  ".join(f"{stage}:{','.join(names[:3]) or 'same'}" for stage, names in told.items())
            print(f"{Path(recording).name}  {name:<14}  {row}", flush=True)
    sys.exit(1 if n_different else 0)


if __name__ == "__main__":
    main()
