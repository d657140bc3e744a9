"""Ordered work on a few threads. OpenCV and the kernels release the GIL, so threads are enough: nothing is pickled or copied."""

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item], *, workers: int, ahead: int = 4) -> Iterator[Result]:
    """Yield ``function(item)`` for each item, in the order of `items`, computed on `workers` threads.

    At most ``workers + ahead`` results are finished or under way beyond the one the caller holds, so memory stays bounded however
    slow the caller is. An error in `function` is raised where its result would have come; leaving the loop early cancels the rest.
    """
    with _one_thread_in_opencv(), ThreadPoolExecutor(max_workers=workers, thread_name_prefix="slamcli") as pool:
        pending: deque[Future[Result]] = deque()
        try:
            for item in items:
                pending.append(pool.submit(function, item))
                if len(pending) >= workers + ahead:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


@contextmanager
def one_thread_in_blas() -> Iterator[None]:
    """Keep the BLAS of numpy and of scipy to one thread: with more, sums run in another order and the last digits differ.

    Our systems are small and sparse, so nothing is lost; waiting threads would only burn CPU time.
    """
    import numpy as np  # noqa: F401
    import scipy.linalg  # noqa: F401  # both libraries must be loaded to be told
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield


@contextmanager
def least_instructions_in_opencv() -> Iterator[None]:
    """Keep OpenCV to the instructions that every x86-64 processor has: its blurs of real numbers round otherwise with others."""
    import cv2

    before = cv2.useOptimized()
    cv2.setUseOptimized(False)
    try:
        yield
    finally:
        cv2.setUseOptimized(before)


@contextmanager
def _one_thread_in_opencv() -> Iterator[None]:
    """Keep OpenCV from starting its own threads within each of ours: the two would multiply."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


class LastUsed(Generic[Result]):
    """Values by number, those used last kept. Several threads may ask at once."""

    def __init__(self, most: int) -> None:
        self._most, self._lock = most, Lock()
        self._kept: OrderedDict[int, Result] = OrderedDict()

    def get(self, number: int, make: Callable[[int], Result]) -> Result:
        """Return the value of a number, made by `make` where it is not kept."""
        with self._lock:
            if number in self._kept:
                self._kept.move_to_end(number)
                return self._kept[number]
        made = make(number)  # by two threads at once at worst: both make the same
        with self._lock:
            self._kept[number] = made
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return made
