"""A short seeded run of the fuzzer over every parser, and that it would notice."""

import contextlib
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import fuzz

from slamcli.errors import SlamError

INPUTS = 40
PARSERS = fuzz.parsers()


@pytest.mark.filterwarnings("ignore")  # of numbers that overflow
@pytest.mark.parametrize("name", PARSERS)
def test_every_mutated_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    fuzz.attempt(PARSERS[name], tmp_path, PARSERS[name].seeds[0], bound=contextlib.nullcontext)  # compiles its kernels
    tally = fuzz.Tally()
    assert [failure.told for failure in fuzz.fuzz(PARSERS[name], tmp_path, inputs=INPUTS, seed=0, tally=tally)] == []
    assert tally.read + tally.refused == INPUTS


@pytest.mark.parametrize("name", PARSERS)
def test_the_good_file_is_read(name: str, tmp_path: Path) -> None:
    for seed in PARSERS[name].seeds[:1]:
        error = fuzz.attempt(PARSERS[name], tmp_path, seed, bound=contextlib.nullcontext)
        assert error is None or name == "image", error


@pytest.mark.filterwarnings("ignore")
def test_every_file_of_a_recording_and_of_a_run_is_read_or_refused_when_it_is_mutated(tmp_path: Path) -> None:
    known = {**fuzz.recordings(tmp_path / "recordings"), **fuzz.runs(tmp_path / "runs")}
    assert len(known) > 15
    for name, parser in known.items():
        error = fuzz.attempt(parser, tmp_path, parser.seeds[0], bound=contextlib.nullcontext)
        assert error is None, (name, error)
        tally = fuzz.Tally()
        assert [failure.told for failure in fuzz.fuzz(parser, tmp_path, inputs=INPUTS, seed=0, tally=tally)] == []
        assert all((tmp_path / other).read_bytes() == good for other, good in parser.others)


def test_a_parser_that_fails_hangs_or_eats_memory_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "SECONDS", 0.2)

    def endless(path: Path) -> None:
        while True:
            pass

    on_a_busy_machine = 300  # times its CPU time that an input may last
    for read, waited, kind in (
        (lambda path: 1 / 0, on_a_busy_machine, "ZeroDivisionError"),
        (endless, on_a_busy_machine, "s of CPU"),
        (lambda path: time.sleep(60), 3, "TooSlowError"),
        (lambda path: bytearray(2 << 30), on_a_busy_machine, "MemoryError"),
    ):
        monkeypatch.setattr(fuzz, "WAITED", waited)
        failures = list(fuzz.fuzz(fuzz.Parser("x", (b"abc",), read), tmp_path, inputs=2, seed=0, tally=fuzz.Tally()))
        assert len(failures) == 1
        assert kind in failures[0].told

    def refuse(path: Path) -> None:
        raise SlamError("no")

    assert not list(fuzz.fuzz(fuzz.Parser("x", (b"abc",), refuse), tmp_path, inputs=5, seed=0, tally=fuzz.Tally()))


def test_the_same_seed_gives_the_same_inputs() -> None:
    import random

    first, again = ([fuzz.mutated(random.Random(k), (b"abc def\n1 2 3\n",)) for k in range(50)] for _ in range(2))
    assert first == again
    assert len(set(first)) > 30
