#!/usr/bin/env python
"""Kill commands at random moments, and at chosen system calls, and look for anything lost, half or left over.

    python scripts/kills.py ONE TWO [--kills 200] [--calls 100] [--commands WORD ...] [--seed 0]

ONE and TWO are recordings of one place. Finished runs of them are made first. Then, again and again, one of the commands of
scripts/stand.py is ended by SIGKILL: after a random time, at the n-th rename, fsync or opening of a file, or in the middle of the write
that makes a file larger than n bytes. What must hold after each: outputs are what they were before, or what they should have become; the
same command given again succeeds, makes the same bytes and leaves nothing beside them. Exit status 1 where anything did not hold.
"""

import argparse
import builtins
import os
import random
import resource
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from stand import COMMANDS, Command, Stand

CALLS: tuple[tuple[object, str], ...] = ((os, "replace"), (os, "fsync"), (os, "rename"), (Path, "rename"), (builtins, "open"))
MOST_CALLS = 12
LARGEST = 21  # powers of 2 of a file's size at which a write is cut
TRIES = 6  # of a command that ended before its end came


def main() -> int:
    """Make the runs, kill, compare."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("one", type=Path)
    options.add_argument("two", type=Path)
    options.add_argument("--kills", type=int, default=200, help="at random moments [200]")
    options.add_argument("--calls", type=int, default=100, help="at chosen calls [100]")
    options.add_argument("--commands", nargs="*", default=[], metavar="WORD", help="only commands that hold one of these words")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    rng = random.Random(given.seed)
    wanted = [command for command in COMMANDS if not given.commands or set(given.commands) & set(command)]
    n_faults, n_killed = 0, {"at a moment": 0, "at a call": 0}
    with tempfile.TemporaryDirectory(prefix="slamcli-kills-") as folder:
        stand = Stand(Path(folder), given.one, given.two, wanted)
        seconds = {command: timed(stand, command) for command in stand.commands}
        for name, wished in (("at a moment", given.kills), ("at a call", given.calls)):
            for number in range(TRIES * wished):
                if n_killed[name] >= wished:
                    break
                command = stand.commands[number % len(stand.commands)]
                stand.reset(command)
                where, ended = (at_a_moment if name == "at a moment" else at_a_call)(stand, command, rng, seconds[command])
                n_killed[name] += ended < 0
                for fault in unlike(stand, command):
                    n_faults += 1
                    print(f"{' '.join(command)}, {where}: {fault}", flush=True)
    print(f"{n_killed['at a moment']} killed at a moment, {n_killed['at a call']} at a call, {n_faults} faults")
    return 1 if n_faults else 0


def timed(stand: Stand, command: Command) -> float:
    """Measure how long a command takes once everything is compiled."""
    import time

    stand.reset(command)
    started = time.monotonic()
    stand.call(command)
    return time.monotonic() - started


def at_a_moment(stand: Stand, command: Command, rng: random.Random, seconds: float) -> tuple[str, int]:
    """Kill a command after a random time."""
    after = rng.uniform(0.0, seconds)
    return f"after {after:.2f} s", stand.call(command, kill_after=after).status


def at_a_call(stand: Stand, command: Command, rng: random.Random, _: float) -> tuple[str, int]:
    """Kill a command at one of its calls, or half-way through a write."""
    if rng.random() < 0.3:
        size = int(2 ** rng.uniform(0, LARGEST))
        return f"in the write beyond {size} bytes", stand.call(command, within=partial(end_in_write, size)).status
    owner, name = rng.choice(CALLS)
    number = rng.randrange(MOST_CALLS)
    return f"at call {number} of {name}", stand.call(command, within=partial(end_at, owner, name, number)).status


def end_in_write(size: int) -> None:
    """Let the system end this process where it makes a file larger than so many bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def end_at(owner: object, name: str, left: int) -> None:
    """End this process at the n-th call of a function that writes."""
    real: Callable = getattr(owner, name)

    def counted(*arguments: object, **options: object) -> object:
        nonlocal left
        mode = str(arguments[1:2] or options.get("mode", ""))
        writes = name != "open" or "w" in mode or "x" in mode
        left -= writes
        if left < 0 and writes:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*arguments, **options)

    setattr(owner, name, counted)


def unlike(stand: Stand, command: Command) -> Iterator[str]:
    """Yield what is lost or half now, and what is not as before when the command was given again."""
    now = stand.contents("out")
    lost = [name for name, digest in stand.good.items() if name.startswith("out/") and now.get(name) != digest]
    if lost or any(name not in stand.good for name in now if "/." not in name):
        yield f"an output is half or gone: {', '.join(lost)}"
    again = [command] if command[0] in ("add", "batch") else [command, ("run", "-r", "run")]
    for words in again:
        ended = stand.call(words)
        if ended.status or "Traceback" in ended.said:
            yield f"{' '.join(words)} then ended with {ended.status}: {ended.said[-300:]}"
    left = list(stand.left_over())
    if left:
        yield f"left over: {', '.join(left)}"
    if changed := stand.differing():
        yield f"not as before: {', '.join(changed)}"
        for words in stand.commands:  # so that one fault is told once
            stand.reset(words)
            stand.call(words)
        stand.good = stand.contents()


if __name__ == "__main__":
    sys.exit(main())
