#!/usr/bin/env python
"""Flip one bit of each file of a finished run in turn: every command that reads it must say so, and `run` must repair it.

    python scripts/flips.py ONE TWO [--run run] [--only PART] [--seed 0]

ONE and TWO are recordings of one place; finished runs of them are made first. It is noted which files of the run every command of
scripts/stand.py opens. Then a bit of each file is flipped in turn. What must hold: a command that opens the file ends with status 1 and a
line that says how to repair it, or, where it asks the record of a stage only whether a sound result is up to date, warns of it; `status
--verify` names it; `run` ends well and makes every file what it was, or removes findings that a command has to make anew; nothing ends in
a traceback. Exit status 1 where anything did not hold.
"""

import argparse
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from stand import COMMANDS, Command, Stand

STATUS = ("status", "--verify")
READERS = (*COMMANDS[5:], ("export-colmap", "model", "-r", "run"), ("config", "-r", "run"), (*STATUS, "-r", "run"))
FIGURES = ("eval/", "inspection.json")  # findings, which no stage makes
MAKES_FIGURES = (("eval", "ape", "-r", "run"), ("eval", "map", "-r", "run"), ("report", "-r", "run"))
REPAIRS = ("slamcli run", "slamcli eval", "damaged", "not as slamcli wrote it")  # of which a refusal holds one
UNREAD = (".lock", "log.txt", "report.html")  # that no command opens


def main() -> int:
    """Make the runs, flip, compare."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("one", type=Path)
    options.add_argument("two", type=Path)
    options.add_argument("--run", default="run", choices=("run", "house", "grown"), help="run, or house or grown: of both recordings")
    options.add_argument("--only", default="", metavar="PART", help="only files in whose path PART occurs")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    with tempfile.TemporaryDirectory(prefix="slamcli-flips-") as folder:
        makers = {"run": (), "house": COMMANDS[2:3], "grown": COMMANDS[3:4]}[given.run]  # readers are given once the run is whole
        stand = Stand(Path(folder), given.one, given.two, makers)
        return Flips(stand, given.run).all(random.Random(given.seed), given.only)


class Flips:
    """One run of a stand, and which of its files each command opens."""

    def __init__(self, stand: Stand, run: str) -> None:
        self.stand, self.run = stand, run
        for command in MAKES_FIGURES:
            self.stand.call(tuple(run if word == "run" else word for word in command))
        self.stand.good = self.stand.contents()
        shutil.copytree(run, "kept")
        self.opened: dict[Command, set[str]] = {}
        for command in READERS:
            words = tuple(run if word == "run" else word for word in command)
            shutil.rmtree("model", ignore_errors=True)
            ended = stand.call(words, within=partial(note_opened, Path(run).resolve(), Path("opened").resolve()))
            if ended.status == 0:
                self.opened[words] = set(Path("opened").read_text().splitlines())
        self.n = dict.fromkeys(("flipped", "read", "noticed", "repaired", "faults"), 0)

    def all(self, rng: random.Random, only: str) -> int:
        """Flip one bit of each file in turn."""
        for path in sorted(path for path in Path("kept").rglob("*") if path.is_file()):
            name, size = str(path.relative_to("kept")), path.stat().st_size
            if path.name in UNREAD or only not in name or not size:
                continue
            bit = rng.randrange(8 * size)
            self.n["flipped"] += 1
            for fault in (*self.noticed(name, bit), *self.repaired(name, bit)):
                self.n["faults"] += 1
                print(f"{name}, bit {bit}: {fault}", flush=True)
        print(", ".join(f"{number} {name}" for name, number in self.n.items()))
        return 1 if self.n["faults"] else 0

    def noticed(self, name: str, bit: int) -> Iterator[str]:
        """Give every command that opens the file; yields those that go on all the same."""
        self._spoil(name, bit)
        for command, opened in self.opened.items():
            if name not in opened:
                continue
            self.n["read"] += 1
            shutil.rmtree("model", ignore_errors=True)
            ended = self.stand.call(command)
            is_told = any(word in ended.said for word in REPAIRS)
            is_warned = name.endswith("/stage.json") and "Warning: " in ended.said and "is damaged)" in ended.said
            is_fine = is_told and (ended.status == 1 or command[:2] == STATUS or is_warned)
            if "Traceback" in ended.said:
                yield f"{' '.join(command)}: a traceback: {ended.said[-300:]}"
            elif is_fine:
                self.n["noticed"] += 1
            else:
                yield f"{' '.join(command)}: not noticed ({ended.status}): {ended.said[-300:].strip()}"

    def repaired(self, name: str, bit: int) -> Iterator[str]:
        """Have the run repaired; yields what is not as before."""
        self._spoil(name, bit)
        ended = self.stand.call(("run", "-r", self.run))
        if ended.status or "Traceback" in ended.said:
            yield f"run: ended with {ended.status}: {ended.said[-300:]}"
        changed = [one for one in self.stand.differing() if one.startswith(f"{self.run}/")]
        changed += [str(path) for path in Path("kept").rglob("*") if not (self.run / path.relative_to("kept")).exists()]
        if name.startswith(FIGURES):
            changed = [
                one
                for one in changed
                if one != f"{self.run}/{name}" and not (one == f"kept/{name}" and f"{name} was damaged" in ended.said)
            ]
        if changed:
            yield f"run: not as before: {', '.join(changed)}"
        else:
            self.n["repaired"] += 1

    def _spoil(self, name: str, bit: int) -> None:
        """Put the good run back, but for the bit."""
        shutil.rmtree(self.run, ignore_errors=True)
        shutil.copytree("kept", self.run)
        path = Path(self.run) / name
        data = bytearray(path.read_bytes())
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)


def note_opened(run: Path, list_file: Path) -> None:
    """Write the names of a run's files down as this process opens them for reading."""
    note = os.open(list_file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    home = f"{run}/"

    def hook(event: str, arguments: tuple) -> None:
        if event == "open" and isinstance(arguments[0], (str, bytes, os.PathLike)) and not (arguments[2] or 0) & os.O_ACCMODE:
            path = os.path.abspath(os.fsdecode(arguments[0]))
            if path.startswith(home):
                os.write(note, f"{path.removeprefix(home)}\n".encode())

    sys.addaudithook(hook)


if __name__ == "__main__":
    sys.exit(main())
