"""One HTML page about a run that opens from disk anywhere: what came out, how good it is, what to doubt, what it cost."""

from collections.abc import Sequence
from pathlib import Path

from slamcli import files
from slamcli.errors import SlamError
from slamcli.evaluation import run_content
from slamcli.hints import hint
from slamcli.report import page, pictures
from slamcli.runs.run_directory import RunDir

__all__ = ["make"]


def make(run: RunDir, out: Path, *, inspected: Sequence[tuple[str, str]] = ()) -> None:
    """Write the page of `run` to `out`; SlamError when no stage has made a trajectory yet.

    inspected : level ("error", "warning" or "note") and text of each finding on the recording itself
    """
    content = run_content.collect(run)
    text = page.render(content, pictures.draw(run, content), inspected)
    try:
        files.write_text(out, text)
    except OSError as error:
        raise SlamError(f"{out}: cannot be written ({error.strerror}); choose another place: {hint().report(run.path, 'PAGE')}") from error
