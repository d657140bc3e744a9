"""One HTML page about a run that opens from disk anywhere: what came out, how good it is, what to doubt, what it cost."""

from pathlib import Path

from slamcli import files
from slamcli.evaluation import run_content
from slamcli.report import page, pictures
from slamcli.runs.run_directory import RunDir

__all__ = ["make"]


def make(run: RunDir, out: Path) -> None:
    """Write the page of `run` to `out`; SlamError when no stage has made a trajectory yet."""
    content = run_content.collect(run)
    files.write_text(out, page.render(content, pictures.draw(run, content)))
