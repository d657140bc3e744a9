"""Next steps that messages advise, in the words of whoever is told: calls of Python, or commands and flags of the shell.

A library says what to do through `hint()`, and writes neither command nor flag itself. A caller in Python then reads
``slamcli.open_run('runs/desk').update(until='track')``; within a command of the program, which speaks the shell's words, the same message
reads ``slamcli run --until track -r runs/desk``. Either can be pasted as it is.
"""

import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager

Where = str | os.PathLike[str]

# Arguments of functions, and the flags of the program that give them.
FLAGS = {
    "path": "-r",
    "data": "--data",
    "settings": "-s",
    "config": "--config",
    "start": "--from",
    "until": "--until",
    "truth": "--truth",
    "workers": "--workers",
    "overwrite": "--overwrite",
}
FLAGS_OF_OPTIONS = {"recording.fps": "--fps", "recording.known_camera": "--camera"}


class Hints:
    """Hints in Python: calls of the API, its arguments, options by their full names."""

    def argument(self, name: str) -> str:
        """Name an argument of the function that was called."""
        return name

    def option(self, name: str) -> str:
        """Name an option, such as recording.fps, so that one knows how to give it."""
        return name

    def setting(self, name: str, value: bool | float | None = None) -> str:
        """Write an option with a value, as it is given for a run; dots for a value that the user knows."""
        return f'settings={{"{name}": {"..." if value is None else repr(value)}}}'

    def options(self) -> str:
        """List the options there are."""
        return "slamcli.config.toml.known_keys()"

    def demo(self) -> str:
        """Make the run of the demo."""
        return 'slamcli.run("demo")'

    def make(self, run: Where) -> str:
        """Make a run in this directory."""
        return f"slamcli.run(TARGET, path={str(run)!r})"

    def update(self, run: Where, *, until: str = "") -> str:
        """Bring a run up to date, or as far as a stage."""
        return f"slamcli.open_run({str(run)!r}).update({f'until={until!r}' if until else ''})"

    def repair(self, run: Where) -> str:
        """Restore the files of a run that are damaged, and make anew what was made of them."""
        return f"slamcli.open_run({str(run)!r}, restore=True).update()"

    def force(self) -> str:
        """Run every stage of a run that is open, or that a command means."""
        return "run.update(force=True)"

    def stage(self, run: Where, stage: str) -> str:
        """Run one stage alone."""
        return f"slamcli.open_run({str(run)!r}).run_stage({stage!r})"

    def add(self, run: Where) -> str:
        """Add a recording to the map of a run."""
        return f"slamcli.open_run({str(run)!r}).add(RECORDING)"

    def report(self, run: Where, page: str = "") -> str:
        """Write the report, to `page` where one is given."""
        return f"slamcli.open_run({str(run)!r}).report({repr(page) if page else ''})"

    def measure(self, run: Where) -> str:
        """Measure a run's trajectory."""
        return f"slamcli.open_run({str(run)!r}).ape()"

    def inspect(self, recording: Where) -> str:
        """Look what is wrong with a recording."""
        return f"slamcli.inspection.inspect({str(recording)!r})"

    def layouts(self) -> str:
        """List the layouts of recordings that open, and how each is told."""
        return "slamcli.datasets.READERS"

    def each_alone(self) -> str:
        """Make a run of each of several recordings."""
        return "slamcli.run(RECORDING) for each"

    def train_vocabulary(self) -> str:
        """Make a vocabulary file."""
        return "slamcli.vision.kmeans.train and slamcli.formats.vocabulary_file.write"

    def import_vocabulary(self) -> str:
        """Read a text file of DBoW2."""
        return "slamcli.formats.dbow2.read"

    def save_view(self) -> str:
        """Write what the viewer shows to a file."""
        return 'slamcli.visualization.rerun_viewer.view(..., save=Path("run.rrd"))'


class ShellHints(Hints):
    """Hints for the shell: whole commands and flags of the program."""

    def argument(self, name: str) -> str:
        """Name the flag."""
        return FLAGS[name]

    def option(self, name: str) -> str:
        """Name the flag that sets the option, or all set options' with its name."""
        return FLAGS_OF_OPTIONS.get(name, f"-s {name}=...")

    def setting(self, name: str, value: bool | float | None = None) -> str:
        """Write the flag with option and value, as TOML has it."""
        shown = "..." if value is None else str(value).lower() if isinstance(value, bool) else f"{value:g}"
        return f"-s {name}={shown}"

    def options(self) -> str:
        """Explain the options."""
        return "slamcli config --explain"

    def demo(self) -> str:
        """Make the run of the demo."""
        return "slamcli run demo"

    def make(self, run: Where) -> str:
        """Make a run in this directory."""
        return f"slamcli run TARGET {run_flag(run)}"

    def update(self, run: Where, *, until: str = "") -> str:
        """Bring a run up to date, or as far as a stage."""
        return f"slamcli run {f'--until {until} ' if until else ''}{run_flag(run)}"

    def repair(self, run: Where) -> str:
        """Run again: it restores first."""
        return self.update(run)

    def force(self) -> str:
        """Run every stage of the run that a command means."""
        return "slamcli run --force"

    def stage(self, run: Where, stage: str) -> str:
        """Run one stage alone."""
        return f"slamcli {stage} {run_flag(run)}"

    def add(self, run: Where) -> str:
        """Add a recording to the map of a run."""
        return f"slamcli add {shlex.quote(str(run))} RECORDING"

    def report(self, run: Where, page: str = "") -> str:
        """Write the report, to `page` where one is given."""
        return f"slamcli report {run_flag(run)}{f' -o {page}' if page else ''}"

    def measure(self, run: Where) -> str:
        """Measure a run's trajectory."""
        return f"slamcli eval ape {run_flag(run)}"

    def inspect(self, recording: Where) -> str:
        """Look what is wrong with a recording."""
        return f"slamcli inspect {shlex.quote(str(recording))}"

    def layouts(self) -> str:
        """List the layouts."""
        return "slamcli formats"

    def each_alone(self) -> str:
        """Make a run of each."""
        return "slamcli batch RECORDING..."

    def train_vocabulary(self) -> str:
        """Make a vocabulary file."""
        return "slamcli vocab train"

    def import_vocabulary(self) -> str:
        """Read a text file of DBoW2."""
        return "slamcli vocab import"

    def save_view(self) -> str:
        """Write what the viewer shows to a file."""
        return "slamcli view --save run.rrd"


def run_flag(run: Where) -> str:
    """Return the words that make a command act on this run."""
    return f"-r {shlex.quote(str(run))}"


class _Spoken:
    """The hints of this process. Its threads share them, as they work for one caller."""

    hints = Hints()


def hint() -> Hints:
    """Return the hints that whoever is told understands."""
    return _Spoken.hints


@contextmanager
def spoken(hints: Hints) -> Iterator[None]:
    """Give these hints as long as the block runs."""
    before, _Spoken.hints = _Spoken.hints, hints
    try:
        yield
    finally:
        _Spoken.hints = before
