"""One HTML page about a run that opens from disk anywhere: what came out, how good it is, what to doubt, what it cost."""

from pathlib import Path

from slamcli import files
from slamcli.report import collect, page, pictures
from slamcli.rundir import RunDir

__all__ = ["make"]


def make(run: RunDir, out: Path) -> None:
    """Write the page of `run` to `out`; SlamError when no stage has made a trajectory yet."""
    content = collect.collect(run)
    files.write_text(out, page.render(content, pictures.draw(run, content)))
