"""How the program ends when it is asked to from outside: Ctrl-C, SIGTERM, or a terminal that is gone."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_caught: list[int] = []  # those that `catch` was told of and that were not ignored


class Interrupted(KeyboardInterrupt):
    """One of the signals has come."""

    def __init__(self, number: int = signal.SIGINT, where: str = "") -> None:
        self.number = number
        super().__init__(_word(number) + where)

    @property
    def exit_status(self) -> int:
        """Return the exit status by which a shell knows it."""
        return 128 + self.number


def catch() -> None:
    """Let the signals end this process at once with a word, until `raising`; one that is ignored, as under nohup, stays so."""
    _caught[:] = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    for number in _caught:
        signal.signal(number, _end)


@contextmanager
def raising() -> Iterator[None]:
    """Let the signals that `catch` was told of raise Interrupted within the block, where there is something to put back."""
    try:
        for number in _caught:
            signal.signal(number, _raise)
        yield
    finally:
        for number in _caught:
            signal.signal(number, _end)


def found_in(error: BaseException) -> Interrupted | None:
    """Find the interruption in an exception, None where it is none.

    The interpreter wraps one that comes while a compiled kernel is being called into a SystemError.
    """
    cause: BaseException | None = error
    while isinstance(cause, SystemError):
        cause = cause.__cause__ or cause.__context__
    if isinstance(cause, Interrupted):
        return cause
    return Interrupted() if isinstance(cause, KeyboardInterrupt) else None


def _raise(number: int, _: FrameType | None) -> None:
    raise Interrupted(number)


def _end(number: int, _: FrameType | None) -> None:
    os.write(2, f"Error: {_word(number)}\n".encode())
    os._exit(128 + number)


def _word(number: int) -> str:
    return "interrupted" if number == signal.SIGINT else "terminated"
