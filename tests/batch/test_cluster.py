"""Batches on real schedulers and workers of Dask, on the loopback, with recordings and runs here and in an S3 server."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import Result

pytest.importorskip("distributed", reason="batches need Dask: pip install 'slamcli[cluster]'")

import distributed

from slamcli.batch import cluster, jobs
from slamcli.batch.jobs import Order
from slamcli.batch.worker import Desk, Done
from slamcli.cli.main import cli
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.runs import source_code
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES

Slamcli = Callable[..., Result]
CREDENTIALS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}  # moto takes any
pytestmark = pytest.mark.filterwarnings("default")  # of Dask's and botocore's insides


class Processes:
    """A scheduler and its workers, as their commands start them."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.folder, self.started = folder, []
        self.environment = {
            **os.environ,
            **environment,
            "PYTHONPATH": os.pathsep.join(sys.path),
            "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s",
        }
        address_file = folder / "scheduler.json"
        self.start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0", "--scheduler-file", address_file
        )
        self.address = self._wait_for(lambda: json.loads(address_file.read_text())["address"])

    def start(self, what: str, *arguments: object) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *map(str, arguments)]
        with open(self.folder / "dask.log", "a") as log:
            self.started.append(subprocess.Popen(command, cwd=self.folder, env=self.environment, stdout=log, stderr=log))
        return self.started[-1]

    def worker(self, name: str) -> subprocess.Popen:
        options = ["--nthreads", "1", "--no-dashboard", "--no-nanny", "--name", name, "--host", "127.0.0.1"]
        return self.start("worker", self.address, *options, "--local-directory", self.folder / "scratch")

    def stop(self) -> None:
        for process in reversed(self.started):
            process.kill()
            process.wait()

    @staticmethod
    def _wait_for(value: Callable[[], str]) -> str:
        for _ in range(300):
            try:
                return value()
            except (OSError, ValueError, KeyError):
                time.sleep(0.1)
        raise AssertionError("the scheduler did not start")


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """The URL of an empty bucket of an S3 server in this process; workers inherit where it is."""
    pytest.importorskip("s3fs", reason="the S3 tests need s3fs")
    moto = pytest.importorskip("moto.server", reason="the S3 tests need moto and flask-cors")
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**CREDENTIALS, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
            patch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()
        s3fs.S3FileSystem().mkdir("maps")
        yield "s3://maps"
    server.stop()


@pytest.fixture(scope="module")
def dask(bucket: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """A scheduler and two workers."""
    processes = Processes(tmp_path_factory.mktemp("dask"), {})
    try:
        for name in ("one", "two"):
            processes.worker(name)
        with distributed.Client(processes.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield processes
    finally:
        processes.stop()


@pytest.fixture
def recordings(room: Path, tmp_path: Path) -> list[Path]:
    """Two recordings of equal content; their runs have equal bytes."""
    return [Path(shutil.copytree(room, tmp_path / "recordings" / name)) for name in ("a", "b")]


def same_as(room_run: Path, run: RunDir, *, until: str = NAMES[-1]) -> None:
    """Compare every stage's inputs, configuration, sources and outputs with those of the local run."""
    local = RunDir(room_run)
    for name in NAMES[: NAMES.index(until) + 1]:
        here, there = local.record(name), run.record(name)
        assert there is not None, name
        assert (there["key"], there["digest"], there["outputs"]) == (here["key"], here["digest"], here["outputs"]), name


# real processes


def test_the_results_are_those_of_local_runs_and_a_second_batch_does_nothing(
    dask: Processes, recordings: list[Path], room_run: Path, here: Path, slamcli: Slamcli
) -> None:
    command = ["batch", *recordings, "--out", "runs", "--cluster", dask.address]
    first = slamcli(*command)
    assert first.exit_code == 0, first.output
    assert first.stdout.split() == [str(here / "runs" / "batch.csv"), str(here / "runs" / "batch.html")]
    assert "2/2" in first.stderr
    for recording in recordings:
        same_as(room_run, RunDir(here / "runs" / recording.name))
    written = {path: path.stat().st_mtime_ns for path in here.glob("runs/*/*/stage.json")}
    assert len(written) == 2 * len(NAMES)
    assert slamcli(*command).exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in here.glob("runs/*/*/stage.json")} == written
    assert len((here / "runs" / "batch.csv").read_text().splitlines()) == 3


def test_from_s3_to_s3_and_back_to_a_local_run(
    dask: Processes, bucket: str, room: Path, room_run: Path, here: Path, slamcli: Slamcli
) -> None:
    import s3fs

    store = s3fs.S3FileSystem()
    store.put(str(room), "maps/in/room", recursive=True)
    command = ["batch", f"{bucket}/in/room", "--out", f"{bucket}/out", "--cluster", dask.address]
    done = slamcli(*command)
    assert done.exit_code == 0, done.output
    store.invalidate_cache()
    store.get("maps/out/room", str(here / "run"), recursive=True)
    run = RunDir(here / "run")
    same_as(room_run, run)
    assert run.info()["root"] == f"{bucket}/in/room"
    assert "1 recordings: 1 done" in store.cat_file("maps/out/batch.html").decode()
    before = store.info("maps/out/room/grid2d/stage.json")["LastModified"]
    store.rm_file("maps/out/room/octree/map.bt")  # damaged while nobody looked
    assert slamcli(*command).exit_code == 0
    store.invalidate_cache()
    assert store.exists("maps/out/room/octree/map.bt")
    plan = slamcli(*command, "--dry-run")
    assert plan.stdout.splitlines()[1].split()[2:] == [*NAMES, "-"]
    assert store.info("maps/out/room/track/stage.json")["LastModified"] <= before, "what was whole is not made again"
    assert not list((dask.folder / "scratch").glob("**/slamcli/room")), "workers keep no copies"


def test_a_worker_that_is_killed_costs_its_task_and_nothing_else(
    dask: Processes, recordings: list[Path], room_run: Path, here: Path, slamcli: Slamcli
) -> None:
    victim = dask.worker("victim")
    order = Order(out=str(here / "runs"), until="optimize")
    rows = []
    with jobs.prepared(order) as order, distributed.Client(dask.address, set_as_default=False) as client:
        client.wait_for_workers(3, timeout=60)
        for row in cluster.work_off(client, jobs.jobs([str(r) for r in recordings], order), progress=_killing(victim, after=3)):
            rows.append(row)
    assert victim.poll() == -signal.SIGKILL
    assert sorted(row["state"] for row in rows) == ["done"] * 2
    for recording in recordings:
        same_as(room_run, RunDir(here / "runs" / recording.name), until="optimize")


def _killing(victim: subprocess.Popen, *, after: int):
    """Progress that kills a process when so many tasks have ended."""

    def progress(items, label, total=None):
        for n, item in enumerate(items):
            if n == after:
                victim.kill()
                victim.wait()
            yield item

    return progress


def test_a_client_that_is_killed_is_succeeded_by_the_next(dask: Processes, recordings: list[Path], room_run: Path, here: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "slamcli",
        "batch",
        *map(str, recordings),
        "--out",
        "runs",
        "--cluster",
        dask.address,
        "--until",
        "track",
    ]
    first = subprocess.Popen(command, cwd=here, env=dask.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not list(here.glob("runs/*/extract/stage.json")):
        assert first.poll() is None
        time.sleep(0.05)
    first.kill()
    first.wait()
    early = {path: path.stat().st_mtime_ns for path in here.glob("runs/*/extract/stage.json")}
    second = subprocess.run(command, cwd=here, env=dask.environment, capture_output=True, text=True, timeout=120)
    assert second.returncode == 0, second.stderr
    for recording in recordings:
        same_as(room_run, RunDir(here / "runs" / recording.name), until="track")
    assert all(path.stat().st_mtime_ns == when for path, when in early.items())


def test_a_scheduler_that_is_lost_ends_the_batch_with_a_word(recordings: list[Path], tmp_path: Path) -> None:
    processes = Processes(tmp_path, {})
    processes.worker("only")
    command = [sys.executable, "-m", "slamcli", "batch", str(recordings[0]), "--out", "runs", "--cluster", processes.address]
    try:
        with distributed.Client(processes.address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=60)
        batch = subprocess.Popen(
            command, cwd=tmp_path, env=processes.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        while not list(tmp_path.glob("runs/*/extract")):
            assert batch.poll() is None
            time.sleep(0.02)
        processes.started[0].kill()
        _, told = batch.communicate(timeout=60)
    finally:
        processes.stop()
    assert batch.returncode == 1
    assert "scheduler is lost" in told and "Traceback" not in told


def test_a_scheduler_without_workers_and_none_at_all_are_said(tmp_path: Path, slamcli: Slamcli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECT", 1.0)
    processes = Processes(tmp_path, {})
    try:
        empty = slamcli("batch", "demo", "--out", tmp_path / "runs", "--cluster", processes.address)
    finally:
        processes.stop()
    assert empty.exit_code == 1 and "has no workers; start some with: dask worker" in empty.stderr
    gone = slamcli("batch", "demo", "--out", tmp_path / "runs", "--cluster", processes.address)
    assert gone.exit_code == 1 and "no Dask scheduler answers" in gone.stderr


def test_a_worker_with_another_program_is_refused(dask: Processes, monkeypatch: pytest.MonkeyPatch, slamcli: Slamcli, here: Path) -> None:
    monkeypatch.setattr(source_code, "of_package", lambda: "0" * 12)
    refused = slamcli("batch", "demo", "--out", "runs", "--cluster", dask.address)
    assert refused.exit_code == 1
    assert "of other sources than the client's" in refused.stderr
    assert "install the same version on every worker" in refused.stderr


# within this process


@pytest.fixture(scope="module")
def inside() -> Iterator[distributed.Client]:
    """A cluster in this process, so that a test can change what its worker does."""
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as made,
        distributed.Client(made, set_as_default=False) as client,
    ):
        yield client


def run_inside(client: distributed.Client, out: Path, recordings: list[str], **options) -> list[dict]:
    with jobs.prepared(Order(out=str(out), until="match")) as order:
        return sorted(cluster.work_off(client, jobs.jobs(recordings, order), **options), key=lambda row: row["run"])


def test_a_recording_that_fails_says_why_is_not_tried_again_and_leaves_the_others_alone(
    inside: distributed.Client, recordings: list[Path], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (recordings[1] / "rgb.txt").write_text("")
    tries = []
    original = Desk.run_stage
    monkeypatch.setattr(Desk, "run_stage", lambda self, *given: tries.append(self.job.name) or original(self, *given))
    rows = run_inside(inside, here / "runs", [*map(str, recordings), "tum/none"])
    assert [row["state"] for row in rows] == ["done", "failed", "failed"]
    assert "rgb.txt" in rows[1]["reason"]
    assert tries.count("b") == 1


def test_what_a_machine_did_wrong_is_tried_again_a_limited_number_of_times(
    inside: distributed.Client, recordings: list[Path], here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(times: int):
        left = iter(range(times))

        def run_stage(self: Desk, *given) -> Done:
            if next(left, None) is not None:
                raise OSError(28, "No space left on device")
            return original(self, *given)

        return run_stage

    original = Desk.run_stage
    monkeypatch.setattr(Desk, "run_stage", failing(2))
    (row,) = run_inside(inside, here / "runs", [str(recordings[0])], retries=2)
    assert row["state"] == "done"
    monkeypatch.setattr(Desk, "run_stage", failing(3))
    (row,) = run_inside(inside, here / "runs", [str(recordings[1])], retries=2)
    assert row["state"] == "failed" and "No space left on device" in row["reason"]


def test_a_recording_that_kills_its_workers_fails_with_a_hint(inside: distributed.Client, recordings: list[Path], here: Path) -> None:
    (job,) = jobs.jobs([str(recordings[0])], Order(out=str(here / "runs")))
    error = distributed.KilledWorker(task="run_stage-1", last_worker=SimpleNamespace(address="tcp://127.0.0.1:1"), allowed_failures=3)
    row = cluster._row(job, SimpleNamespace(status="error", exception=lambda: error))
    assert row["state"] == "failed" and "for want of memory" in row["reason"]


def test_a_worker_that_does_not_see_the_folder_says_so(inside: distributed.Client, recordings: list[Path], here: Path) -> None:
    (job,) = jobs.jobs([str(recordings[0])], Order(out=str(here / "runs"), until="match", marker=".batch-elsewhere"))
    (row,) = cluster.work_off(inside, [job], retries=0)
    assert row["state"] == "failed" and "must share it" in row["reason"]


def test_settings_reach_every_run(inside: distributed.Client, recordings: list[Path], here: Path) -> None:
    order = Order(out=str(here / "runs"), until="extract", settings=("extract.features=120",), threads=3)
    with jobs.prepared(order) as order:
        rows = list(cluster.work_off(inside, jobs.jobs([str(recordings[0])], order)))
    config = RunDir(here / "runs" / "a").config()
    assert rows[0]["state"] == "done" and config.extract.features == 120
    assert config.run.workers == Config().run.workers, "threads are the batch's, not the run's"


# the command


def test_a_dry_run_starts_nothing(here: Path, room_run: Path, slamcli: Slamcli) -> None:
    shutil.copytree(room_run, here / "runs" / "room")
    shutil.rmtree(here / "runs" / "room" / "grid2d")
    (here / "room").mkdir()
    lines = slamcli("batch", "room", "demo", "--out", "runs", "--dry-run").stdout.splitlines()
    assert lines[1].split()[1:] == [str(here / "runs" / "room"), *NAMES]
    assert lines[2].split() == ["demo", str(here / "runs" / "demo"), "-", *NAMES]
    assert not (here / "runs" / "demo").exists()


def test_settings_are_checked_before_anything_starts(here: Path, slamcli: Slamcli) -> None:
    wrong = slamcli("batch", "demo", "-s", "track.min_inlier=3")
    assert wrong.exit_code == 1 and "did you mean track.min_inliers" in wrong.stderr
    assert slamcli("batch", "demo", "--cluster", "tcp://x:1", "--workers", "2").exit_code == 2
    assert list(here.iterdir()) == []


def test_the_local_cluster_keeps_within_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    import distributed.system

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(distributed.system, "MEMORY_LIMIT", 7 << 30)
    assert cluster.local_size(None) == (3, 2, (7 << 30) // 3)
    assert cluster.local_size(8) == (8, 1, (7 << 30) // 8)
    monkeypatch.setattr(distributed.system, "MEMORY_LIMIT", 1 << 30)
    assert cluster.local_size(None)[0] == 1


def test_without_dask_a_hint(here: Path, slamcli: Slamcli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SlamError, match=r"pip install 'slamcli\[cluster\]'"):
        cluster._quiet()
    assert "batch" in cli.commands


def test_a_cluster_of_this_machine_leaves_nothing_in_the_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with cluster.local(1, 1 << 30) as client:
        assert len(client.nthreads()) == 1
        assert any(tmp_path.iterdir())
        profiled = client.run(lambda: __import__("dask").config.get("distributed.worker.profile.enabled"))
        assert list(profiled.values()) == [False]
    assert list(tmp_path.iterdir()) == []


def test_a_cluster_of_this_machine_needs_no_port_that_another_program_has(recwarn: pytest.WarningsRecorder) -> None:
    with socket.socket() as other:
        with suppress(OSError):  # taken already
            other.bind(("127.0.0.1", 8787))
            other.listen()
        with cluster.local(1, 1 << 30) as client:
            assert client.submit(sum, (1, 2)).result(timeout=60) == 3
    assert not [str(warning.message) for warning in recwarn if issubclass(warning.category, UserWarning)]
