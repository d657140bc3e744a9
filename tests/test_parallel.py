"""Ordered work on threads: order, bounded read-ahead, errors in their place, OpenCV's threads put back."""

import threading
import time

import cv2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from threadpoolctl import threadpool_info

from slamcli.parallel import LastUsed, least_instructions_in_opencv, one_thread_in_blas, ordered_map


@settings(max_examples=30, deadline=None)
@given(n=st.integers(0, 30), workers=st.integers(1, 5), ahead=st.integers(0, 5))
def test_it_equals_map_whatever_the_number_of_threads(n: int, workers: int, ahead: int) -> None:
    def square(i: int) -> int:
        time.sleep(0.0005 * (i % 3))
        return i * i

    assert list(ordered_map(square, range(n), workers=workers, ahead=ahead)) == [i * i for i in range(n)]


def test_the_work_is_on_several_threads() -> None:
    meeting = threading.Barrier(2, timeout=20)
    names = list(ordered_map(lambda _: (meeting.wait(), threading.current_thread().name)[1], range(2), workers=2))
    assert len(set(names)) == 2


def test_it_reads_no_further_ahead_than_told() -> None:
    taken: list[int] = []

    def items():
        for i in range(100):
            taken.append(i)
            yield i

    results = ordered_map(lambda i: i, items(), workers=2, ahead=3)
    assert next(results) == 0
    assert len(taken) == 5
    assert next(results) == 1
    assert len(taken) == 6
    results.close()


def test_an_error_comes_where_its_result_would_have_come_and_the_rest_is_cancelled() -> None:
    started: list[int] = []

    def work(i: int) -> int:
        started.append(i)
        if i == 3:
            raise ValueError("frame 3")
        return i

    results = ordered_map(work, range(1000), workers=2, ahead=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="frame 3"):
        next(results)
    assert len(started) < 20


def test_blas_keeps_to_one_thread_meanwhile_and_gets_its_own_back() -> None:
    def threads() -> list[int]:
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    before = threads()
    with one_thread_in_blas():
        assert len(threads()) >= 1
        assert set(threads()) == {1}
    assert threads()[: len(before)] == before


@pytest.mark.parametrize("ends", ["exhausted", "left early", "error"])
def test_opencv_keeps_to_one_thread_meanwhile_and_gets_its_own_back(ends: str) -> None:
    before = cv2.getNumThreads()

    def threads(i: int) -> int:
        if ends == "error":
            raise ValueError("bad")
        return cv2.getNumThreads()

    results = ordered_map(threads, range(3), workers=2)
    if ends == "error":
        with pytest.raises(ValueError, match="bad"):
            next(results)
    elif ends == "left early":
        assert next(results) == 1
        results.close()
    else:
        assert list(results) == [1, 1, 1]
    assert cv2.getNumThreads() == before


def test_opencv_keeps_to_the_least_instructions_meanwhile_and_gets_the_others_back() -> None:
    def fail() -> None:
        with least_instructions_in_opencv():
            assert not cv2.useOptimized()
            raise KeyError

    before = cv2.useOptimized()
    with pytest.raises(KeyError):
        fail()
    assert cv2.useOptimized() == before


def test_what_was_used_last_is_kept_and_the_rest_made_again() -> None:
    made: list[int] = []
    kept: LastUsed[int] = LastUsed(2)

    def square(number: int) -> int:
        made.append(number)
        return number**2

    assert [kept.get(number, square) for number in (1, 2, 1, 3, 1, 2)] == [1, 4, 1, 9, 1, 4]
    assert made == [1, 2, 3, 2], "2 was used longest ago when 3 came"
