"""Make a run in a process of its own: its peak memory is then that of its stages, not of what was done before them."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import slamcli


def run(target: str | Path, **options: Any) -> slamcli.Run:
    """Call `slamcli.run` with these options in a new process; what it raises is raised here."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        return slamcli.open_run(pool.submit(_run, str(target), options).result())


def _run(target: str, options: dict[str, Any]) -> str:
    from slamcli import console

    console.set_up(0)
    return str(slamcli.run(target, **{"progress": console.progress, "tell": console.say, **options}).path)
