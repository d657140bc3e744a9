"""The extract of one recording on several workers: the same bytes, and parts that cover every frame once."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("distributed", reason="batches need Dask: pip install 'slamcli[cluster]'")

from slamcli import datasets
from slamcli.batch import jobs, worker
from slamcli.batch.jobs import Order
from slamcli.batch.worker import Part, part_rows
from slamcli.runs.run_directory import RunDir


@given(n_frames=st.integers(0, 5000), n_parts=st.integers(1, 40))
def test_parts_cover_every_frame_once_in_order_and_are_even(n_frames: int, n_parts: int) -> None:
    parts = [part_rows(n_frames, k, n_parts) for k in range(n_parts)]
    assert [row for part in parts for row in part] == list(range(n_frames))
    sizes = [len(part) for part in parts if len(part)]
    assert max(sizes, default=0) - min(sizes, default=0) <= 1
    assert len(sizes) <= 1 or min(sizes) >= worker.LEAST_PART


@pytest.fixture
def job(room: Path, here: Path, monkeypatch: pytest.MonkeyPatch):
    """A job whose 40 frames are worth two parts."""
    monkeypatch.setattr(worker, "LEAST_PART", 15)
    with jobs.prepared(Order(out=str(here / "runs"), until="extract")) as order:
        yield jobs.jobs([str(room)], order)[0]


def extracted(job: jobs.Job, n_parts: int) -> list[Part]:
    return [worker.extract_part(job, k, n_parts, worker.identity()) for k in range(n_parts)]


def test_parts_give_the_bytes_of_the_whole_and_their_cost_is_counted(job: jobs.Job, room_run: Path) -> None:
    parts = extracted(job, 3)
    assert [len(part.frames) for part in parts] == [20, 20, 0]
    assert not Path(job.run).exists(), "parts leave no trace"
    done = worker.run_stage(job, "extract", None, worker.identity(), parts)
    assert done.was_run and not done.failure
    here, there = RunDir(Path(job.run)).record("extract"), RunDir(room_run).record("extract")
    assert (here["key"], here["outputs"], here["summary"]) == (there["key"], there["outputs"], there["summary"])
    assert here["cpu_seconds"] >= sum(part.cpu_seconds for part in parts)
    assert all(part == Part(()) for part in extracted(job, 2)), "what is up to date is not extracted again"
    assert not worker.run_stage(job, "extract", None, worker.identity(), parts).was_run


@pytest.mark.parametrize("lost", [0, 1])
def test_without_all_parts_the_stage_does_its_own_work(job: jobs.Job, room_run: Path, lost: int) -> None:
    parts = extracted(job, 2)
    parts[lost] = Part(())
    assert worker.run_stage(job, "extract", None, worker.identity(), parts).was_run
    assert RunDir(Path(job.run)).record("extract")["digest"] == RunDir(room_run).record("extract")["digest"]


def test_a_recording_that_cannot_be_read_fails_once_in_the_stage(job: jobs.Job, room: Path, here: Path) -> None:
    broken = shutil.copytree(room, here / "broken")
    (broken / "rgb.txt").write_text("")
    (bad,) = jobs.jobs([str(broken)], job.order)
    parts = extracted(bad, 2)
    assert parts == [Part(()), Part(())]
    assert "rgb.txt" in worker.run_stage(bad, "extract", None, worker.identity(), parts).failure


def test_a_batch_opens_a_recording_once_and_the_next_batch_looks_again(room: Path, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, really = list[str](), datasets.open_dataset

    def counted(target: str, **how: Any) -> Any:
        opened.append(target)
        return really(target, **how)

    monkeypatch.setattr(datasets, "open_dataset", counted)
    recording = shutil.copytree(room, here / "room")

    def batch(*settings: str) -> dict[str, Any]:
        opened.clear()
        with jobs.prepared(Order(out=str(here / "runs"), settings=settings, until="match")) as order:
            (job,) = jobs.jobs([str(recording)], order)
            done = None
            for stage in job.stages:
                done = worker.run_stage(job, stage, done, worker.identity())
            assert done is not None
            return worker.finish(job, done)

    assert (batch()["frames"], len(opened)) == (40, 1)
    colour = (recording / "rgb.txt").read_text().splitlines(keepends=True)
    (recording / "rgb.txt").write_text("".join(colour[:-5]))
    assert (batch()["frames"], len(opened)) == (35, 1)
    assert (batch("recording.every=2")["frames"], len(opened)) == (18, 1)
