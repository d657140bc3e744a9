"""Change one setting, compare the trajectory's error and the time.

    python examples/compare_setting.py [RECORDING] [KEY=VALUE] [FOLDER]

RECORDING needs a ground truth; without it the demo is run, a simulated room. Only the stages that the setting concerns run twice: the
second run starts as a copy of the first.
"""

import shutil
import sys
from pathlib import Path

import slamcli


def main(recording: str = "demo", setting: str = "extract.features=500", folder: str = "runs/compare") -> None:
    """Make both runs and print a line for each."""
    default = slamcli.run(recording, path=Path(folder) / "default", until="loop")
    copy = Path(folder) / setting.replace("/", "_")  # each setting's own: a run keeps what it was given before
    if not copy.exists():
        shutil.copytree(default.path, copy)
    changed = slamcli.open_run(copy).update(settings=[setting], until="loop")

    for name, run in (("default", default), (setting, changed)):
        ape = run.ape().to_dict()
        seconds = sum(record["cpu_seconds"] - record["compile_seconds"] for s in run.summary() if (record := run.record(s)))
        print(f"{name:24s} APE {ape['rmse']:.4f} m, {ape['n_poses']} of {ape['n_frames']} frames, {seconds:.1f} s of CPU time")


if __name__ == "__main__":
    main(*sys.argv[1:])
