"""Which sources a stage can reach, and their digests: a result is stale when one of them has changed.

Followed are the import statements of the text, wherever in a file they stand, from the stage's own file on. Nothing is imported for it
and nothing is parsed as a whole: `slamcli status` asks this each time.
"""

import functools
import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from slamcli.stages import stage_named

PACKAGE = Path(__file__).parents[1]
DIGITS = 12  # hexadecimal, of a file's digest: chance equality of two states of a file is out of the question
SHOWN = 3  # changed files that a reason names
READING = "datasets/__init__.py"  # through it the pipeline opens the recording for a stage that needs one
JOINING = ["datasets/joined.py", "stages/joining.py"]  # of several recordings
DATA = "data/"  # what code names and reads; data within folders of it are named by none
READERS = "datasets/readers/"  # loaded by name, one for each layout

# Reached by imports, yet without influence on what a stage computes from its inputs.
APART = frozenset(
    {
        "__init__.py",  # the API's names
        "stages/contract.py",  # says in Protocols what a stage is given
        "stages/__init__.py",  # the table: what of it matters to a stage, its needs and its sections, is in the key itself
        "config/options.py",  # declares the options, whose values are in the key
        "console.py",  # what the user sees
        "hints.py",  # what the user is advised
        "jit/cache.py",  # where machine code is kept
        "jit/compilation.py",  # when it is compiled
        "user_cache.py",
        "datasets/demo.py",  # makes a recording, which is known by its own digest
        "datasets/download.py",  # likewise
    }
)

# From the beginning of a line on.
FOR_TYPE_CHECKERS = re.compile(r"( *)if TYPE_CHECKING:\n(?:\1 +.*\n|\n)+")
IMPORT = re.compile(r" *(?:from +(slamcli[\w.]*) +import +(\([^)]*\)|.*)|import +(slamcli[\w.]*))")


@functools.cache
def of_stage(name: str, reader: str = "") -> Mapping[str, str]:
    """Return the digest of every file that a stage can reach, by its name within the package. They are read once a process.

    reader : the layout of the recording, whose reader counts for a stage that needs the recording; "" = none. Of several recordings
        it is "joined" and their layouts, with "+" between them
    """
    start = [f"stages/{name}.py"]
    if "dataset" in stage_named(name).needs:
        start += [READING] + [file for file in (f"{READERS}{one}.py" for one in reader.split("+")) if file in _files()]
    if reader.startswith("joined+"):
        start += JOINING
    return {file: _digest(file) for file in sorted(reachable(start))}


@functools.cache
def of_package() -> str:
    """Digest all sources of the package, as they are when it is first asked."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(f"{path.relative_to(PACKAGE).as_posix()} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()[:DIGITS]


def changes(recorded: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Say which files differ between two states, such as "slam/tracker.py changed"; "" where none does."""
    if not recorded:
        return "its sources were not recorded"
    changed = [] if recorded == now else sorted(file for file in recorded.keys() | now.keys() if recorded.get(file) != now.get(file))
    if not changed:
        return ""
    more = f" and {len(changed) - SHOWN} more" if len(changed) > SHOWN else ""
    return f"{', '.join(changed[:SHOWN])}{more} changed"


def reachable(start: list[str]) -> set[str]:
    """List the files that these import, directly or through others, themselves included, and the data files that they name."""
    found, open_ = set(start), list(start)
    while open_:
        for file in imported(open_.pop()):
            if file not in found and file not in APART:
                found.add(file)
                open_.append(file)
    return found | {data for file in found for data in _data_named_in(file)}


@functools.cache
def imported(file: str) -> frozenset[str]:
    """List the files of this package that a file imports; what only type checkers see is left out."""
    return frozenset().union(*(_files_named(*names) for names in _imports(_content(file).decode())))


def _imports(text: str) -> Iterator[tuple[str, str, str]]:
    """Return of each import statement a, b of ``from a import b`` and c of ``import c``."""
    unseen = [block.span() for block in _at_lines_with("if TYPE_CHECKING:", FOR_TYPE_CHECKERS, text)]
    for statement in _at_lines_with("slamcli", IMPORT, text):
        if any(first <= statement.start() < end for first, end in unseen):
            continue
        home, names, plain = statement.groups("")
        yield home, names, plain


def _at_lines_with(word: str, pattern: re.Pattern[str], text: str) -> Iterator[re.Match[str]]:
    """Match a pattern from the beginning of each line that holds a word: to search all lines for it takes ten times as long."""
    place = text.find(word)
    while place >= 0:
        if found := pattern.match(text, text.rfind("\n", 0, place) + 1):
            yield found
        place = text.find(word, max(place + 1, found.end() if found else 0))


@functools.cache  # one statement stands in many files
def _files_named(home: str, names: str, plain: str) -> frozenset[str]:
    """List the files that ``from home import names`` or ``import plain`` reads; a name may be a module or within one."""
    below = "/".join([*home.split(".")[1:], ""])
    listed = [below + name.split()[0] for name in names.split("#")[0].strip("() \n").split(",") if name.strip()]
    return _files_of(plain or home).union(file for name in listed for file in (f"{name}.py", f"{name}/__init__.py") if file in _files())


@functools.cache
def _files_of(module: str) -> frozenset[str]:
    """Return the file of a module and those of the packages it lies in; what is no module gives those alone."""
    parts = module.split(".")[1:]
    packages = ["/".join([*parts[:k], "__init__.py"]) for k in range(len(parts) + 1)]
    return _files() & {*packages, "/".join(parts) + ".py"}


@functools.cache
def _files() -> frozenset[str]:
    """List the package's files; one walk is cheaper than asking for each name that an import may mean."""
    found = ((os.path.relpath(folder, PACKAGE), names) for folder, _, names in os.walk(PACKAGE))
    return frozenset(name if folder == "." else f"{folder}/{name}".replace(os.sep, "/") for folder, names in found for name in names)


@functools.cache
def _content(file: str) -> bytes:
    with open(f"{PACKAGE}/{file}", "rb", buffering=0) as source:  # `Path.read_bytes` takes twice as long
        return source.read()


@functools.cache
def _data_named_in(file: str) -> tuple[str, ...]:
    return tuple(data for data in _data() if data.removeprefix(DATA).encode() in _content(file))


@functools.cache
def _data() -> tuple[str, ...]:
    return tuple(sorted(file for file in _files() if file.startswith(DATA)))


@functools.cache
def _digest(file: str) -> str:
    return hashlib.sha256(_content(file)).hexdigest()[:DIGITS]
