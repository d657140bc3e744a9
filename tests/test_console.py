"""Progress, tables and the line that tells a finished stage; what a stage costs."""

import ctypes
import gc
import io
import logging
import sys
import time
import weakref

import numpy as np
import pytest
from numba import njit

from slamcli import console
from slamcli.runs import cost_meter
from slamcli.runs.cost_meter import Meter


class Terminal(io.StringIO):
    """A stderr that someone looks at."""

    def isatty(self) -> bool:
        return True


def test_progress_is_silent_where_nobody_looks(capsys: pytest.CaptureFixture) -> None:
    assert list(console.progress(range(3), "track")) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")


def test_progress_shows_a_bar_with_the_unit_of_the_label(monkeypatch: pytest.MonkeyPatch) -> None:
    for label, unit in (("track", "frames"), ("unpack [files]", "files")):
        screen = Terminal()
        monkeypatch.setattr(sys, "stderr", screen)
        assert list(console.progress(iter(range(3)), label, 3)) == [0, 1, 2]
        assert label.split()[0] in screen.getvalue()
        assert f" {unit}/s" in screen.getvalue()


def test_a_message_goes_above_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    console.set_up(0)
    for _ in console.progress(range(2), "track"):
        logging.getLogger("slamcli.test").warning("frame is dark")
    assert "Warning: frame is dark\n" in screen.getvalue()


def test_table_aligns_columns() -> None:
    assert console.table([["a", "1", "x"], ["bbb", "22"]], right=[1]) == "a     1  x\nbbb  22"


TOLD = ("key_frames", "landmarks", "lost")


def record(**changes: object) -> dict:
    base = {"stage": "track", "seconds": 14.2, "fps": 95.9, "compile_seconds": 0.0, "n_warnings": 0}
    return {**base, "summary": {"frames": 1362, "key_frames": 173, "rms": 0.51234, "cost": [2, 1]}, **changes}


def test_a_finished_stage_is_told_in_one_line() -> None:
    assert console.stage_line(record(), TOLD) == "track      1362 frames  14.2 s  95.9 fps  173 key frames"
    assert "3 warnings" in console.stage_line(record(n_warnings=3), TOLD)
    assert "4.5 s of it compiling kernels, this once" in console.stage_line(record(compile_seconds=4.5), TOLD)
    ones = {"key_frames": 1, "frames_without_depth": 1, "lost": 1, "rms": 1.0}
    assert console.stage_line(record(summary=ones, n_warnings=1), None).endswith(
        "  1 key frame  1 frame without depth  1 lost  1 rms  1 warning"
    )
    assert console.stage_line(record(summary={}, fps=None), TOLD) == "track      14.2 s"


def test_more_of_a_stage_is_told_when_asked_for_and_nothing_when_quiet(capsys: pytest.CaptureFixture) -> None:
    try:
        console.set_up(1)
        assert console.stage_line(record(), TOLD) == "track      1362 frames  14.2 s  95.9 fps  173 key frames  0.5123 rms"
        by_name = record(summary={"key_frame_reasons": {"new surface": 3, "overdue": 2}})
        assert console.stage_line(by_name, TOLD) == "track      14.2 s  95.9 fps  key frame reasons: 3 new surface, 2 overdue"
        console.set_up(0, quiet=True)
        console.say("made")
        logging.getLogger("slamcli.test").warning("frame is dark")
    finally:
        console.set_up(0)
    assert capsys.readouterr().err == "Warning: frame is dark\n"


def test_counts_read_as_a_number_and_its_name() -> None:
    summary = {"frames": 3, "key_frames": 2, "lost": 0, "share": 0.51234, "is_floor_found": True, "spans": [1]}
    assert console.counts(summary) == ["2 key frames", "0 lost", "0.5123 share", "is floor found: yes"]
    assert console.counts(summary, ("lost", "key_frames")) == ["2 key frames"]


def test_the_meter_sees_time_memory_and_cpu() -> None:
    with Meter() as idle:
        time.sleep(0.2)
    assert 0.2 <= idle.seconds < 5
    assert 0 <= idle.cpu_seconds < 0.15
    with Meter() as busy:
        held = np.ones(32 << 20)  # 256 MiB
        time.sleep(0.1)
        del held
    assert 200 < busy.peak_rss_mb - idle.peak_rss_mb < 320
    assert idle.taken_mb < 50 and 200 < busy.taken_mb < 320  # not what the process held before
    assert busy.cpu_seconds > 0.01


def test_the_meter_counts_compilation_and_says_so_once() -> None:
    @njit
    def inner(x):
        return x + 1.0

    @njit
    def outer(x):
        return inner(x) * 2.0

    said: list[str] = []
    with Meter() as meter:
        meter.watch_compiler(said.append)
        outer(1.0)
        inner(1)
    assert 0 < meter.compile_seconds <= meter.seconds
    assert len(said) == 1 and "compiling kernels" in said[0]
    with Meter() as again:
        again.watch_compiler(said.append)
        outer(1.0)
    assert again.compile_seconds == 0
    assert len(said) == 1


def test_free_memory_is_handed_back_or_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    held = [np.ones(64 << 10) for _ in range(200)]  # 100 MB, in pieces that the C library keeps when they are freed between others
    kept, before = held[::2], cost_meter._resident_mb()
    del held
    cost_meter.return_free_memory(0.0)
    assert cost_meter._resident_mb() <= before - 25.0 and len(kept) == 100
    monkeypatch.setattr(ctypes, "CDLL", lambda _: object())
    cost_meter.return_free_memory(0.0)


@pytest.mark.parametrize(("taken_mb", "is_freed"), [(cost_meter.MUCH - 1.0, False), (cost_meter.MUCH + 1.0, True)])
def test_objects_that_hold_one_another_are_freed_after_a_stage_that_took_much(taken_mb: float, is_freed: bool) -> None:
    class Node:
        other: "Node"

    gc.disable()
    try:
        one, two = Node(), Node()
        one.other, two.other = two, one
        alive = weakref.ref(one)
        del one, two
        cost_meter.return_free_memory(taken_mb)
        assert (alive() is None) == is_freed
    finally:
        gc.enable()
