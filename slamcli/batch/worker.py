"""What a worker does for one recording. Every task may be given again, to any worker: what is done already is found and kept.

A recording that cannot be worked off, and why, is a result like any other. Whatever else goes wrong, a full disk or a storage that does
not answer, is an exception, which Dask answers by trying again.
"""

import logging
import shutil
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from slamcli import __version__
from slamcli.batch import storage
from slamcli.batch.jobs import Job
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.datasets import Dataset, open_dataset
from slamcli.errors import SlamError
from slamcli.hints import spoken
from slamcli.jit import compilation
from slamcli.parallel import one_thread_in_blas
from slamcli.runs import source_code
from slamcli.runs.cost_meter import Meter
from slamcli.runs.creation import create_run, writing
from slamcli.runs.pipeline import Begun, Pipeline, environment
from slamcli.runs.run_directory import RunDir
from slamcli.stages import extract, stage_named

LEAST_PART = 100  # frames: fewer take less time than opening a recording and sending what was found

# OpenCV's threads, BLAS and the cost meter belong to the process, so that a worker with several threads runs one stage at a time.
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Done:
    """The end of a task."""

    stage: str
    failure: str = ""  # why the recording cannot go on, as the user is told; "" when it can
    was_run: bool = False  # or was up to date


@dataclass(frozen=True)
class Part:
    """A part of a recording's frames, extracted on one worker."""

    frames: tuple[Any, ...]  # of stages.extract, in order; () where there was nothing to do
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_rss_mb: float = 0.0


def identity() -> dict[str, Any]:
    """Say which program this process runs: version, digest of the sources, versions of the libraries."""
    return {"slamcli": __version__, "code": source_code.of_package(), "environment": dict(environment())}


def run_stage(job: Job, stage: str, before: Done | None, client: dict[str, Any], parts: Sequence[Part] = ()) -> Done:
    """Bring one stage of a recording up to date, unless an earlier one has failed.

    client : the client's `identity`; a worker that runs another program refuses, so that the task goes elsewhere
    parts : of extract, all the recording's frames in order; without them it is done here
    """
    if before is not None and before.failure:
        return before
    _check(client)
    with _ONE_AT_A_TIME, spoken(job.order.hints()):
        try:
            return Desk(job).run_stage(stage, parts)
        except SlamError as error:
            return Done(stage, failure=str(error))


def extract_part(job: Job, part: int, n_parts: int, client: dict[str, Any]) -> Part:
    """Extract one of `n_parts` parts of a recording's frames: nothing where extract is up to date, and where there are few frames."""
    _check(client)
    with _ONE_AT_A_TIME:
        try:
            return Desk(job).extract(part, n_parts)
        except SlamError:  # the stage itself will tell
            return Part(())


def _check(client: dict[str, Any]) -> None:
    if (here := identity())["code"] != client["code"]:
        raise RuntimeError(f"this worker runs slamcli {here['slamcli']} of other sources than the client's {client['slamcli']}")


def finish(job: Job, last: Done) -> dict[str, Any]:
    """Close a recording: judge it and give its row of the table."""
    from slamcli.batch import figures

    row = {"recording": job.recording, "run": job.run, "state": "failed" if last.failure else "done", "reason": last.failure}
    with _ONE_AT_A_TIME, spoken(job.order.hints()):
        desk = Desk(job)
        try:
            if not last.failure:
                desk.open(job.order.until)
            return {**row, **figures.of_run(desk.directory, _last.recording_of(job))}
        except SlamError as error:
            return {**row, "state": "failed", "reason": str(error)}


def clear(job: Job, dask_worker: Any = None) -> None:
    """Remove a worker's copies of what lies elsewhere; Dask passes the worker, as no task is running that could ask for it."""
    shutil.rmtree(_scratch(dask_worker) / job.name, ignore_errors=True)


class _LastOpened:
    """The recording that this worker opened last: the tasks of one follow on one another, and opening a long one takes a second."""

    def __init__(self) -> None:
        self._kept: tuple[Job, Config, Dataset] | None = None

    def recording_of(self, job: Job, config: Config | None = None) -> Dataset | None:
        """Return the recording of a job, opened under the same configuration where one is given, if that is the last; None otherwise."""
        if self._kept is None or self._kept[0] != job:
            return None
        _, under, dataset = self._kept
        is_same = config is None or (config.camera, config.recording) == (under.camera, under.recording)
        return dataset if is_same else None

    def keep(self, job: Job, config: Config, dataset: Dataset) -> None:
        """Keep a recording until the next; a copy of what lies elsewhere is not kept, as another batch may bring another copy."""
        self._kept = (job, config, dataset) if job.order.marker and not storage.is_url(job.recording) else None


_last = _LastOpened()


class Desk:
    """Where a worker has a job's run and recording: in their own places, or as copies of what lies elsewhere."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.is_stored = storage.is_url(job.run)
        self.copies = _scratch() / job.name
        self.directory = RunDir(self.copies / "run" if self.is_stored else Path(job.run))

    def open(self, until: str) -> str:
        """Bring recording and run, as far as a stage, to this machine; returns what `slamcli run` would be told."""
        job, recording = self.job, self.job.recording
        if storage.is_url(recording):
            recording = str(storage.fetch_recording(recording, self.copies))
        if self.is_stored:
            self._stored().pull(recording, until=until)
        elif not (Path(job.order.out) / job.order.marker).is_file():
            raise RuntimeError(f"{job.order.out} is not the folder that the client means: workers and client must share it")
        return recording

    def extract(self, part: int, n_parts: int) -> Part:
        """Extract one part of the frames."""
        target, order, directory = self.open("extract"), self.job.order, self.directory
        config = self._resolve(directory.config())
        dataset = open_dataset(target, data=order.data, camera=dict(config.camera) or None, options=config.recording)
        rows = part_rows(len(dataset), part, n_parts)
        is_made = (directory.path / "run.json").exists()
        if not rows or (is_made and Pipeline(directory, config, dataset=dataset).states()["extract"].is_fresh):
            return Part(())
        compilation.ensure()
        with Meter() as meter, one_thread_in_blas():
            found = tuple(extract.frames(dataset, config.extract, rows, workers=order.threads))
        return Part(found, meter.seconds, meter.cpu_seconds, meter.peak_rss_mb)

    def _resolve(self, own: Config | None) -> Config:
        return toml.resolve(self.job.order.config or own, None, self.job.order.settings)

    def run_stage(self, stage: str, parts: Sequence[Part] = ()) -> Done:
        """Bring the run up to date as far as `stage`, in general that stage alone."""
        target, order = self.open(stage), self.job.order
        logging.getLogger("slamcli").setLevel(logging.DEBUG)  # a run's log.txt has everything, here as from the command line
        directory, dataset, config = create_run(
            [target],
            resolve=self._resolve,
            path=self.directory.path,
            data=order.data,
            opened=lambda _, config: _last.recording_of(self.job, config),
        )
        _last.keep(self.job, config, dataset)
        # Another process may still be at it for a client that has died since: what it makes is then found up to date.
        with writing(directory, config, wait=True):
            before = _written(directory, stage)
            threads = replace(config, run=replace(config.run, workers=order.threads))
            pipeline = Pipeline(directory, threads, dataset=dataset)
            if (begun := _begun(parts, len(dataset))) and not pipeline.states()[stage].is_fresh:
                pipeline.run_stage(stage_named(stage), begun=begun)
            else:
                pipeline.bring_up_to_date(until=stage)
        if self.is_stored:
            self._stored().push(stage, self.job.recording if storage.is_url(self.job.recording) else target)
        return Done(stage, was_run=_written(directory, stage) != before)

    def _stored(self) -> storage.StoredRun:
        return storage.StoredRun(self.job.run, self.directory.path)


def part_rows(n_frames: int, part: int, n_parts: int) -> range:
    """Divide frames evenly into parts of at least LEAST_PART frames; the parts that are then left over are empty."""
    n_parts = max(1, min(n_parts, n_frames // LEAST_PART))
    return range(part * n_frames // n_parts, (part + 1) * n_frames // n_parts) if part < n_parts else range(0)


def _begun(parts: Sequence[Part], n_frames: int) -> Begun | None:
    """Say how extract goes on from its parts; None unless they are all there."""
    found = [frame for part in parts for frame in part.frames]
    if not found or len(found) != n_frames:
        return None
    return Begun(
        go_on=partial(extract.assemble, found),
        seconds=max(part.seconds for part in parts),
        cpu_seconds=sum(part.cpu_seconds for part in parts),
        peak_rss_mb=max(part.peak_rss_mb for part in parts),
    )


def _written(directory: RunDir, stage: str) -> int:
    """When a stage was put in place [ns]; 0 where it is not there."""
    path = directory.path / stage / "stage.json"
    return path.stat().st_mtime_ns if path.exists() else 0


def _scratch(of: Any = None) -> Path:
    """Name the folder for a worker's copies, of the one that runs this task if none is given; Dask removes it with the worker."""
    from distributed import get_worker

    try:
        return Path((of or get_worker()).local_directory) / "slamcli"
    except ValueError:  # outside of a worker
        return Path(tempfile.gettempdir()) / "slamcli-batch"
