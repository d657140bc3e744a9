#!/usr/bin/env python
"""Let the disk be full at so many sizes for every command: one clean line, and whatever was there before is still there.

    python scripts/full_disk.py ONE TWO [--sizes 50] [--commands WORD ...]

ONE and TWO are recordings of one place. Finished runs of them lie on a file system in memory (mounting it asks for the superuser) that is
then made so small that the next command of scripts/stand.py finds room for 0, 1, 2 ... parts of what it writes. What must hold each time:
it succeeds, or ends with status 1 and one line (of a batch one a recording) that names the place and what to do; no traceback; outputs of
before are untouched, a run's stages complete; nothing is left over; with room again the same command succeeds with the same bytes. Exit
status 1 where anything did not hold.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from stand import COMMANDS, Command, Stand

PAGE = 4096  # bytes; a file takes whole ones
ROOMY = "4g"


def main() -> int:
    """Make the runs, fill the disk, compare."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("one", type=Path)
    options.add_argument("two", type=Path)
    options.add_argument("--sizes", type=int, default=50, help="of free room, for each command, beside powers of 2 [50]")
    options.add_argument("--commands", nargs="*", default=[], metavar="WORD", help="only commands that hold one of these words")
    given = options.parse_args()
    wanted = [command for command in COMMANDS if not given.commands or set(given.commands) & set(command)]
    n_tried = n_refused = n_faults = 0
    with disk() as folder:
        stand = Stand(folder, given.one, given.two, wanted)
        for command in stand.commands:
            refused: dict[int, bool] = {}  # by the bytes that were free
            for free in rooms(refused, given.sizes):
                refused[free], faults = tried(stand, command, free)
                for fault in faults:
                    n_faults += 1
                    print(f"{' '.join(command)}, {free} bytes free: {fault}", flush=True)
            n_tried += len(refused)
            n_refused += sum(refused.values())
            told = f"{max(refused):>9} bytes are enough, refused at {sum(refused.values())} of {len(refused)} sizes"
            print(f"{' '.join(command):<60} {told}", flush=True)
        os.chdir("/")
    print(f"{n_tried} tried, {n_refused} refused, {n_faults} faults")
    return 1 if n_faults else 0


@contextmanager
def disk() -> Iterator[Path]:
    """Mount a file system whose size can be changed."""
    with tempfile.TemporaryDirectory(prefix="slamcli-disk-") as folder:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={ROOMY}", "tmpfs", folder], check=True)
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)


def resize(folder: Path, size: str) -> None:
    """Change the size of the file system."""
    subprocess.run(["mount", "-o", f"remount,size={size}", folder], check=True)


def used(folder: Path) -> int:
    """Return the bytes in use."""
    state = os.statvfs(folder)
    return (state.f_blocks - state.f_bfree) * state.f_frsize


def rooms(refused: Mapping[int, bool], sizes: int) -> Iterator[int]:
    """Double the room until it is enough, then go through so many sizes below that; `refused` tells how the one before ended."""
    enough = 16 * PAGE
    yield enough
    while refused[enough]:
        enough *= 2
        yield enough
    yield from sorted({enough * k // sizes // PAGE * PAGE for k in range(sizes)} - refused.keys())


def tried(stand: Stand, command: Command, free: int) -> tuple[bool, list[str]]:
    """Give a command with so much room; returns whether it was refused, and what did not hold."""
    stand.reset(command)
    before, stages = stand.contents(), finished(stand)
    resize(stand.folder, str(used(stand.folder) + free))
    ended = stand.call(command)
    resize(stand.folder, ROOMY)
    faults = []
    if "Traceback" in ended.said:
        faults.append(f"a traceback: {ended.said[-400:]}")
    elif ended.status not in (0, 1):
        faults.append(f"status {ended.status}: {ended.said[-300:]}")
    elif ended.status == 1:
        lines = [line for line in ended.said.splitlines() if line.startswith("Error") or ": failed: " in line]  # the latter of a batch
        most = len({"ONE", "TWO"} & set(command)) if command[0] == "batch" else 1
        if not 1 <= len(lines) <= most or not all("No space left" in line and "/" in line for line in lines):
            faults.append(f"not one line that names the place: {ended.said[-300:]}")
    now = stand.contents()
    outputs = [name for name, digest in before.items() if name.startswith("out/") and now.get(name) != digest]
    if outputs:
        faults.append(f"an earlier output is gone or changed: {', '.join(outputs)}")
    if gone := stages - finished(stand):
        faults.append(f"stages are gone: {', '.join(sorted(gone))}")
    if left := list(stand.left_over()):
        faults.append(f"left over: {', '.join(left)}")
    again = stand.call(command)
    if again.status:
        faults.append(f"with room again it ended with {again.status}: {again.said[-300:]}")
    if changed := stand.differing():
        faults.append(f"with room again not as before: {', '.join(changed)}")
    return ended.status == 1, faults


def finished(stand: Stand) -> set[str]:
    """Name the stages that are there."""
    return {str(path) for path in stand.folder.rglob("stage.json") if not any(part.startswith(".") for part in path.parts)}


if __name__ == "__main__":
    sys.exit(main())
