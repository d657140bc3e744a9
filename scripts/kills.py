#!/usr/bin/env python
"""Kill commands at random moments, and at chosen system calls, and look for anything lost, half or left over.

    python scripts/kills.py RECORDING [--kills 200] [--calls 100] [--flips] [--seed 0]

A finished run of RECORDING is made first. Then, again and again, one of `run`, the exports, `report`, `eval` and `localize` is started on a
copy of it and ended by SIGKILL, after a random time or at the n-th write, fsync or rename of its life. What must hold after each: outputs
are what they were before, or what they should have become; the same command given again succeeds, makes the same bytes and leaves nothing
beside them. --flips changes one bit of each file of the run in turn instead: the run must be repaired to the same bytes. Exit status 1
where anything did not hold.
"""

import argparse
import hashlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COMMANDS = (
    ("run", "-r", "run", "--from", "match"),
    ("run", "-r", "run", "--from", "densify"),
    ("export-trajectory", "out/t.txt", "-r", "run"),
    ("export-cloud", "out/cloud.ply", "-r", "run"),
    ("export-octree", "out/map.bt", "-r", "run"),
    ("export-grid", "out/map.pgm", "-r", "run"),
    ("report", "-r", "run", "-o", "out/report.html", "--no-inspect"),
    ("eval", "ape", "-r", "run"),
    ("localize", "run", "RECORDING", "--out", "out/localized.txt"),
)
CHANGING = (".lock", "log.txt", "stage.json", "run.json", "report.html", "latest")  # times are in them
CALLS = ("os.replace", "os.fsync", "os.rename", "pathlib.Path.rename", "builtins.open")
# Runs the command in this process and kills it at the n-th call of a function.
CHILD = """
import builtins, os, pathlib, signal, sys
name, left = sys.argv[1], int(sys.argv[2])
module, _, function = name.rpartition(".")
owner = {"os": os, "builtins": builtins, "pathlib.Path": pathlib.Path}[module]
real = getattr(owner, function)
def counted(*arguments, **options):
    global left
    writes = function != "open" or "w" in str(arguments[1:2] or options.get("mode", "")) or "x" in str(arguments[1:2])
    left -= writes
    if left < 0 and writes:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments, **options)
setattr(owner, function, counted)
sys.argv = ["slamcli", *sys.argv[3:]]
from slamcli.__main__ import main
main()
"""


def main() -> int:
    """Make the run, kill, compare."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("recording", type=Path)
    options.add_argument("--kills", type=int, default=200, help="at random moments [200]")
    options.add_argument("--calls", type=int, default=100, help="at chosen calls [100]")
    options.add_argument("--flips", action="store_true", help="change one bit of each file of the run instead")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    rng = random.Random(given.seed)
    with tempfile.TemporaryDirectory(prefix="slamcli-kills-") as folder:
        stand = Stand(Path(folder), given.recording.resolve())
        faults = stand.flips(rng) if given.flips else stand.kills(rng, given.kills, given.calls)
    print(f"{stand.n_tried} tried, {stand.n_killed} killed, {len(faults)} faults", *faults, sep="\n  ")
    return 1 if faults else 0


class Stand:
    """A finished run, what its commands make of it, and a copy to be spoilt."""

    def __init__(self, folder: Path, recording: Path) -> None:
        self.folder, self.recording = folder, recording
        self.n_tried = self.n_killed = 0
        (folder / "out").mkdir()
        self.seconds = {}
        for command in (("run", str(recording), "-r", "run"), *COMMANDS):
            started = time.monotonic()
            self.call(command).check_returncode()
            self.seconds[command] = time.monotonic() - started
        self.good = self.contents()

    def call(
        self, command: tuple[str, ...], *, at: tuple[str, int] | None = None, after: float | None = None
    ) -> subprocess.CompletedProcess:
        """Run a command, if need be to a violent end."""
        arguments = [str(self.recording) if word == "RECORDING" else word for word in command]
        start = [sys.executable, "-m", "slamcli"] if at is None else [sys.executable, "-c", CHILD, at[0], str(at[1])]
        environment = {
            **os.environ,
            "TMPDIR": str(self.folder),
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path[1:]]),
        }
        child = subprocess.Popen(
            [*start, *arguments], cwd=self.folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            _, said = child.communicate(timeout=after)
        except subprocess.TimeoutExpired:
            child.kill()
            _, said = child.communicate()
        return subprocess.CompletedProcess(command, child.returncode, "", said)

    def contents(self) -> dict[str, str]:
        """Digest what must be the same whenever it is made."""
        paths = (path for top in ("run", "out") for path in (self.folder / top).rglob("*") if path.is_file())
        return {
            str(path.relative_to(self.folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.name not in CHANGING
        }

    def kills(self, rng: random.Random, n_random: int, n_calls: int) -> list[str]:
        """Kill so many commands; tells what did not hold."""
        faults = []
        for number in range(n_random + n_calls):
            command = rng.choice(COMMANDS)
            at = (rng.choice(CALLS), rng.randrange(12)) if number >= n_random else None
            done = self.call(command, at=at, after=None if at else rng.uniform(0.05, self.seconds[command]))
            self.n_tried, self.n_killed = self.n_tried + 1, self.n_killed + (done.returncode == -9)
            where = f"{number}: {' '.join(command)} {at or ''}"
            outputs = {name: value for name, value in self.contents().items() if name.startswith("out/") and "/." not in name}
            if outputs != {name: value for name, value in self.good.items() if name.startswith("out/")}:
                faults.append(f"{where}: an output is half or gone")
            faults += self.settled(where, command)
        return faults

    def settled(self, where: str, command: tuple[str, ...]) -> list[str]:
        """Return the same command again, bring the run up to date, and compare everything."""
        faults = []
        for again in (command, ("run", "-r", "run")):
            done = self.call(again)
            if done.returncode or "Traceback" in done.stderr:
                faults.append(f"{where}: {' '.join(again)} then ended with {done.returncode}: {done.stderr[-300:]}")
        if (now := self.contents()) != self.good:
            changed = sorted(name for name in now.keys() | self.good.keys() if now.get(name) != self.good.get(name))
            faults.append(f"{where}: not as before: {', '.join(changed)}")
        left = [path.name for path in self.folder.iterdir() if path.name not in ("run", "out", "runs")]
        left += [str(path) for path in (self.folder / "run").glob(".*") if path.name != ".lock"]
        for name in left:
            faults.append(f"{where}: left over: {name}")
            shutil.rmtree(self.folder / name, ignore_errors=True)
        return faults

    def flips(self, rng: random.Random) -> list[str]:
        """Change one bit of each file of the run in turn and have it repaired."""
        faults = []
        for name in sorted(str(path.relative_to(self.folder)) for path in (self.folder / "run").rglob("*") if path.is_file()):
            path = self.folder / name
            data = bytearray(path.read_bytes())
            if path.name in (".lock", "log.txt") or "eval" in path.parts or not data:
                continue
            bit = rng.randrange(8 * len(data))
            data[bit // 8] ^= 1 << bit % 8
            path.write_bytes(data)
            self.n_tried += 1
            faults += self.settled(f"{name}, bit {bit}", COMMANDS[2 + self.n_tried % 4] if "." not in name else ("run", "-r", "run"))
        return faults


if __name__ == "__main__":
    sys.exit(main())
