"""How much of memory this process may reserve at all: below some bound C libraries end it without a word."""

import resource

from slamcli.errors import SlamError

# Reserved by the libraries of a run of small pictures. With less, a thread of theirs that finds none left ends the process: an exception
# that nothing catches, or glibc's "cannot allocate memory for thread-local data".
LEAST = 1 << 30  # bytes


def require() -> None:
    """Raise SlamError where `ulimit -v` leaves this process less address space than the libraries reserve."""
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most != resource.RLIM_INFINITY and most < LEAST:
        raise SlamError(
            f"this process may reserve {most >> 20} MiB of address space, and {LEAST >> 20} are needed; raise the limit with: ulimit -v unlimited"
        )
