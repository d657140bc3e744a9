"""`python -m slamcli`, and the command `slamcli`."""

import io
import os
import sys

from slamcli import interruption


def main() -> None:
    """Run the command line in a process of its own, for which signals, standard streams and libraries are set up first."""
    interruption.catch()  # before anything heavy is imported
    _open_what_is_closed()
    _say_any_name()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # a run uses one, and each reserves memory that may not be there
    from slamcli.cli.main import cli

    cli(prog_name="slamcli")


def _open_what_is_closed() -> None:
    """Open the standard streams that the caller has closed: else the next file opened would get their number, and what is said."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115  # for the life of the process


def _say_any_name() -> None:
    """Let standard output take names that are not valid in its encoding; standard error does so by itself."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        is_utf8 = sys.stdout.encoding.lower().replace("-", "") == "utf8"
        sys.stdout.reconfigure(errors="surrogateescape" if is_utf8 else "backslashreplace")


if __name__ == "__main__":
    main()
