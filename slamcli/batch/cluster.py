"""Hand a batch to a Dask cluster: a scheduler that runs already, or one of our own on this machine."""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from slamcli import files
from slamcli.batch import storage, worker
from slamcli.batch.jobs import Job
from slamcli.console import Progress, Tell, silent
from slamcli.errors import SlamError
from slamcli.hints import hint
from slamcli.jit import compilation
from slamcli.runs.pipeline import environment

if TYPE_CHECKING:
    from distributed import Client, Future

log = logging.getLogger(__name__)

MEMORY = 2 << 30  # bytes that a worker should have: more than twice the peak of a run of 30 000 frames
CONNECT = 20.0  # [s] to wait for a scheduler
RETRIES = 2  # of a task that ends in something other than a recording's own fault


def local_size(workers: int | None) -> tuple[int, int, int]:
    """Choose workers, threads a stage and bytes of memory a worker for this machine; within its cores and its memory."""
    from distributed.system import MEMORY_LIMIT

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    n = workers or max(1, min(cores, int(MEMORY_LIMIT) // MEMORY))
    return n, max(1, cores // n), int(MEMORY_LIMIT) // n


@contextmanager
def local(workers: int, memory: int, *, progress: Progress = silent, tell: Tell = log.info) -> "Iterator[Client]":
    """Start a cluster of worker processes on this machine; it ends with the block. SlamError when they do not start."""
    _quiet()
    import dask
    from distributed import Client, LocalCluster

    compilation.ensure(progress=progress, tell=tell)  # once, and not by every worker at the same time
    options: dict[str, Any] = {"n_workers": workers, "threads_per_worker": 1, "memory_limit": memory, "silence_logs": logging.CRITICAL}
    # No dashboard; the scheduler's HTTP server starts all the same, and warns where another program has the usual port.
    options |= {"dashboard_address": None, "scheduler_kwargs": {"dashboard_address": "127.0.0.1:0"}}
    with ExitStack() as stack:
        folder = stack.enter_context(files.scratch("slamcli-batch-"))
        # The scheduler takes no folder else; and nobody looks at what each worker's profiler writes down a hundred times a second.
        stack.enter_context(dask.config.set({"temporary_directory": str(folder), "distributed.worker.profile.enabled": False}))
        try:
            cluster = stack.enter_context(LocalCluster(processes=True, host="127.0.0.1", local_directory=str(folder), **options))
            client = stack.enter_context(Client(cluster))
        except (RuntimeError, TimeoutError) as error:  # what Dask says where a process does not come up in time
            raise SlamError(
                f"the workers do not start ({_first_line(error)}): the machine is too busy or short of memory; start fewer with {hint().argument('workers')}"
            ) from error
        yield client


@contextmanager
def remote(address: str) -> "Iterator[Client]":
    """Connect to a scheduler; SlamError when none answers, when it has no workers, or when one of them runs another program."""
    _quiet()
    from distributed import Client

    try:
        client = Client(address, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SlamError(f"{address}: no Dask scheduler answers ({_first_line(error)}); start one with: dask scheduler") from error
    with client:
        check(client, address)
        yield client


def check(client: "Client", address: str) -> None:
    """Compare every worker's program with the client's: other sources are an error, other versions of libraries a warning."""
    try:
        found = client.run(worker.identity)
    except Exception as error:  # whatever a worker without slamcli answers, it says so
        raise SlamError(f"{address}: a worker cannot run slamcli ({_first_line(error)}); install the client's version there") from error
    if not found:
        raise SlamError(f"{address}: the scheduler has no workers; start some with: dask worker {address} --nthreads 1")
    here = worker.identity()
    for where, there in found.items():
        if there["code"] != here["code"]:
            raise SlamError(
                f"{address}: worker {where} runs slamcli {there['slamcli']} of other sources than the client's {here['slamcli']}; "
                "install the same version on every worker"
            )
        for name, version in environment().items():
            if there["environment"].get(name) != version:
                log.warning(
                    "worker %s has %s %s, the client %s: the last digits may differ", where, name, there["environment"].get(name), version
                )


def work_off(client: "Client", jobs: Sequence[Job], *, retries: int = RETRIES, progress: Progress = silent) -> Iterator[dict[str, Any]]:
    """Run all jobs; yield a row for each as it ends, whether it succeeded or not.

    Earlier recordings come first, so that few are under way at a time. Raises SlamError when the scheduler is lost.
    """
    from distributed import as_completed

    ends: dict[Any, Job] = {}  # by the key of the future that closes it
    futures: list[Future] = []
    here = worker.identity()
    n_parts = len(client.nthreads()) // max(1, len(jobs))  # of a recording, where workers would be idle
    for place, job in enumerate(jobs):
        options = {"priority": -place, "retries": retries, "pure": False}
        parts = [client.submit(worker.extract_part, job, k, n_parts, here, **options) for k in range(n_parts if n_parts > 1 else 0)]
        last: Future | None = None
        for stage in job.stages:
            last = client.submit(worker.run_stage, job, stage, last, here, parts if stage == job.stages[0] else (), **options)
            futures.append(last)
        futures.append(client.submit(worker.finish, job, last, **options))
        ends[futures[-1].key] = job
    for future in progress(as_completed(futures, loop=client.loop), "batch [stages]", len(futures)):
        if future.status in ("cancelled", "lost"):
            raise SlamError("the connection to the scheduler is lost; start it again and give the same command: what is done is kept")
        if future.key in ends:
            job = ends[future.key]
            if storage.is_url(job.run) or storage.is_url(job.recording):
                client.run(worker.clear, job, on_error="ignore")  # on all of them: any may have had a task of this recording
            yield _row(job, future)


def _row(job: Job, end: "Future") -> dict[str, Any]:
    """Take over the row that a worker made; of a task that could not be ended, the exception's first line is the reason."""
    if end.status == "finished":
        return end.result()
    error = end.exception()
    reason = _first_line(error)
    if type(error).__name__ == "KilledWorker":  # by the system, for want of memory, or by its nanny for the same
        few = hint().argument("workers")
        reason = f"every worker that tried it died, perhaps for want of memory; give workers more, or start fewer with {few}"
    return {"recording": job.recording, "run": job.run, "state": "failed", "reason": reason}


def _first_line(error: BaseException | None) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0]}" if text else type(error).__name__


def _quiet() -> None:
    """Keep Dask's own log to what ends something; SlamError where Dask is not installed."""
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise SlamError("a batch needs Dask: pip install 'slamcli[cluster]'") from error
    for name in [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
