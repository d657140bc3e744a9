"""What a worker does for one recording. Every task may be given again, to any worker: what is done already is found and kept.

A recording that cannot be worked off, and why, is a result like any other. Whatever else goes wrong, a full disk or a storage that does
not answer, is an exception, which Dask answers by trying again.
"""

import logging
import shutil
import tempfile
import threading
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from slamcli import __version__, api
from slamcli.batch import storage
from slamcli.batch.jobs import Job
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.runs import pipeline, source_code
from slamcli.runs.pipeline import Pipeline
from slamcli.runs.run_directory import RunDir

# OpenCV's threads, BLAS and the cost meter belong to the process, so that a worker with several threads runs one stage at a time.
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Done:
    """The end of a task."""

    stage: str
    failure: str = ""  # why the recording cannot go on, as the user is told; "" when it can
    was_run: bool = False  # or was up to date


def identity() -> dict[str, Any]:
    """Say which program this process runs: version, digest of the sources, versions of the libraries."""
    return {"slamcli": __version__, "code": source_code.of_package(), "environment": pipeline.environment()}


def run_stage(job: Job, stage: str, before: Done | None, client: dict[str, Any]) -> Done:
    """Bring one stage of a recording up to date, unless an earlier one has failed.

    client : the client's `identity`; a worker that runs another program refuses, so that the task goes elsewhere
    """
    if before is not None and before.failure:
        return before
    if (here := identity())["code"] != client["code"]:
        raise RuntimeError(f"this worker runs slamcli {here['slamcli']} of other sources than the client's {client['slamcli']}")
    with _ONE_AT_A_TIME:
        try:
            return Desk(job).run_stage(stage)
        except SlamError as error:
            return Done(stage, failure=str(error))


def finish(job: Job, last: Done) -> dict[str, Any]:
    """Close a recording: judge it and give its row of the table. This worker's copies of what lies elsewhere are removed."""
    from slamcli.batch import figures

    row = {"recording": job.recording, "run": job.run, "state": "failed" if last.failure else "done", "reason": last.failure}
    with _ONE_AT_A_TIME:
        desk = Desk(job)
        try:
            if not last.failure:
                desk.open(job.order.until)
            return {**row, **figures.of_run(desk.directory)}
        except SlamError as error:
            return {**row, "state": "failed", "reason": str(error)}
        finally:
            desk.clear()


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

    def run_stage(self, stage: str) -> Done:
        """Bring the run up to date as far as `stage`, in general that stage alone."""
        target, order = self.open(stage), self.job.order
        logging.getLogger("slamcli").setLevel(logging.DEBUG)  # a run's log.txt has everything, here as from the command line
        resolve = partial(_resolve, given=order.config, settings=order.settings)
        directory, dataset, config = api.create_run(target, resolve=resolve, path=self.directory.path, data=order.data)
        # Another process may still be at it for a client that has died since: what it makes is then found up to date.
        with api.writing(directory, config, wait=True):
            before = _written(directory, stage)
            threads = replace(config, run=replace(config.run, workers=order.threads))
            Pipeline(directory, threads, dataset=dataset).bring_up_to_date(until=stage)
        if self.is_stored:
            self._stored().push(stage, self.job.recording if storage.is_url(self.job.recording) else target)
        return Done(stage, was_run=_written(directory, stage) != before)

    def clear(self) -> None:
        """Remove this worker's copies."""
        shutil.rmtree(self.copies, ignore_errors=True)

    def _stored(self) -> storage.StoredRun:
        return storage.StoredRun(self.job.run, self.directory.path)


def _resolve(own: Config | None, *, given: Config | None, settings: tuple[str, ...]) -> Config:
    return toml.resolve(given or own, None, settings)


def _written(directory: RunDir, stage: str) -> int:
    """When a stage was put in place [ns]; 0 where it is not there."""
    path = directory.path / stage / "stage.json"
    return path.stat().st_mtime_ns if path.exists() else 0


def _scratch() -> Path:
    """Name this worker's folder for copies; Dask removes it with the worker."""
    try:
        from distributed import get_worker

        return Path(get_worker().local_directory) / "slamcli"
    except ValueError:  # outside of a worker
        return Path(tempfile.gettempdir()) / "slamcli-batch"
