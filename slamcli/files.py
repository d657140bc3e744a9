"""Files that appear whole or not at all, files read with suspicion, and digests."""

import contextlib
import errno
import fcntl
import functools
import hashlib
import json
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader, TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO

from slamcli.errors import SlamError

LARGEST_JSON = 16 << 20  # bytes; a record is a few kB
AT_ONCE = 1 << 20  # bytes digested and written in turn: as many as the processor keeps near
LONGEST_NAME = 200  # bytes of a file name; systems allow 255, and the temporary file's is longer
MOST_LINKS = 40  # followed, as Linux does
ADVICE = {
    errno.ENOSPC: "free some space and give the same command again",
    errno.EDQUOT: "free some space and give the same command again",
    errno.EFBIG: "choose another file system, or raise the limit with: ulimit -f",
    errno.EMFILE: "raise the limit with: ulimit -n 4096",
    errno.ENFILE: "close other programs and give the same command again",
    errno.EACCES: "choose a place you may write to",
    errno.EROFS: "choose a place you may write to",
}
ALIVE = ".alive"  # in a folder of `scratch`, locked as long as its process lives
MOST_DOTS = 32  # in one word of a TOML file: a key of so many parts, or a file name
SEAL = "seal"  # last key of a sealed JSON object: the digest of the text before that digest

TICK_NS = 20_000_000  # ns; file systems take their time from a clock that ticks every 1 to 10 ms

_known: dict[tuple[int, ...], str] = {}  # digests of files this process has read, by what changes when a file does


# written whole


@contextmanager
def whole(path: str | Path, *, through_links: bool = True) -> Iterator[BinaryIO]:
    """Write a file that appears under its name whole or not at all.

    The bytes go to a hidden file beside it, which takes the name when the block ends well and is removed when not; what a killed process
    left is taken over by the next one that writes the same file. A device or a pipe is written to, never replaced; through a link, the
    file that it leads to is. SlamError where it cannot be written; what other files raise meanwhile passes.

    through_links : False replaces a link, a device or a pipe itself, as is due to a file in a run directory, which others may have sent
    """
    path = Path(path)
    with written(path):
        place = _end_of_links(path) if through_links else path
        if place is None:
            with open(path, "wb") as target:
                yield target
            return
        part, file = _open_part(place)
        try:
            with file:
                yield file
                file.flush()
                os.fsync(file.fileno())
                os.replace(part, place)  # while the lock is held: nobody takes the file over for a leftover
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def clear_leftover(path: str | Path) -> None:
    """Remove what a killed process left of this file, unless one that lives is writing it."""
    part = Path(path).with_name(f".{Path(path).name}.part")
    if part.exists() and (file := _take(part)):
        part.unlink(missing_ok=True)
        file.close()


def write_text(path: str | Path, text: str, *, through_links: bool = True) -> None:
    """Replace a text file at once: a reader, or a power cut, meets the old text or the new."""
    write_bytes(path, text.encode(errors="surrogateescape"), through_links=through_links)  # a name in it that is not UTF-8 as it is


def write_bytes(path: str | Path, data: bytes, *, through_links: bool = True) -> None:
    """Replace a file at once; `through_links` is that of `whole`."""
    with whole(path, through_links=through_links) as file:
        file.write(data)


def write_new(path: Path, *parts: memoryview) -> None:
    """Write bytes (uint8) to a file that is not there yet, and digest them on the way: `sha256` then need not read them again."""
    found = hashlib.sha256()
    with written(path), open(path, "xb") as file:
        for part in parts:
            for start in range(0, len(part), AT_ONCE):
                piece = part[start : start + AT_ONCE]
                found.update(piece)
                file.write(piece)
        file.flush()
        _known[version(file.fileno())] = found.hexdigest()


@contextmanager
def written(path: str | Path) -> Iterator[None]:
    """Turn an OSError about this file, or about none as a full disk's, into a SlamError that names it and the next step."""
    try:
        yield
    except OSError as error:
        ours = (str(path), str(Path(path).parent))
        if error.filename is None or str(error.filename) in ours or str(error.filename).endswith(".part"):
            said = "its folder is not there; make it first" if error.errno == errno.ENOENT else told(error)
            raise SlamError(f"{path}: cannot be written ({said})") from error
        raise


def told(error: OSError) -> str:
    """Say what the system says, and what to do about it."""
    said = error.strerror or str(error)
    return f"{said}; {ADVICE[error.errno]}" if error.errno in ADVICE else said


def _end_of_links(path: Path) -> Path | None:
    """Follow links to the regular file, there or to be, that is to be replaced; None for what must be written to where it is.

    The latter are devices, pipes, and whatever a descriptor of a process refers to (/dev/stdout): its owner goes on writing there.
    """
    for _ in range(MOST_LINKS):
        if not path.is_symlink():
            break
        folder = path.parent.resolve()
        if folder == Path("/dev") or folder.is_relative_to("/proc"):
            return None
        path = folder / os.readlink(path)
    else:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return path
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if stat.S_ISREG(mode) and not os.access(path, os.W_OK):  # a rename asks the folder alone
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    return path if stat.S_ISREG(mode) else None


def _open_part(place: Path) -> tuple[Path, BinaryIO]:
    """Open the temporary file that is to become `place`, empty and locked."""
    name = place.name if len(os.fsencode(place.name)) <= LONGEST_NAME else hashlib.sha256(os.fsencode(place.name)).hexdigest()[:32]
    part = place.with_name(f".{name}.part")
    file = _take(part)
    if file is None:  # another process is writing the same file just now
        part = place.with_name(f".{name}.{secrets.token_hex(4)}.part")
        file = open(part, "xb")  # noqa: SIM115  # the caller closes it
    if place.exists() and not place.is_symlink():
        os.fchmod(file.fileno(), stat.S_IMODE(place.stat().st_mode))
    return part, file


def _take(part: Path) -> BinaryIO | None:
    """Open a temporary file for this process alone, emptying what a killed one left; None where it is in use or another user's."""
    try:
        file = open(part, "wb", opener=_open_as_it_is)  # noqa: SIM115  # the caller closes it
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):  # a link or a pipe is none of ours
            return None
        raise
    found = os.fstat(file.fileno())
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_there = os.path.samestat(found, os.lstat(part))  # else its owner has just put it in place
    except OSError:
        is_there = False
    if not is_there or not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid() or found.st_nlink != 1:
        file.close()
        return None
    file.truncate(0)
    return file


def _open_as_it_is(path: str, _: int) -> int:
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)


@contextmanager
def scratch(prefix: str) -> Iterator[Path]:
    """Make a folder for this process alone, removed in the end; what killed processes left under this prefix is removed first."""
    for left in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with contextlib.suppress(OSError), open(left / ALIVE, "rb") as file:  # another user's, or removed by another process just now
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if left.lstat().st_uid == os.geteuid():
                shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=prefix) as folder, open(Path(folder) / ALIVE, "xb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield Path(folder)


# read with suspicion


def read_bytes(path: str | Path, *, limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes; SlamError for a larger one and for a device or a pipe, which may never end."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1) if size <= limit else b""  # reserves at once what it is asked for
    if max(size, len(data)) > limit:
        raise SlamError(f"{path}: too large; such a file has at most {limit} bytes")
    return data


def open_regular(path: str | Path) -> BufferedReader:
    """Open a file for reading; SlamError where it is no regular one. A pipe without a writer is refused instead of waited for."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a NUL byte in the name
        raise SlamError(f"{str(path)!r}: not the name of a file") from error
    file = os.fdopen(descriptor, "rb") if stat.S_ISREG(os.fstat(descriptor).st_mode) else None
    if file is None:
        os.close(descriptor)
        raise SlamError(f"{path}: not a regular file; a device or a pipe cannot be read here")
    return file


def open_own(path: str | Path) -> TextIOWrapper:
    """Open a text file of a run for reading and appending, making it where it is not there.

    SlamError where a link, a device or a pipe has its place: who sent the run would have another file changed, or us wait.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise SlamError(f"{path}: a link has the place of a run's own file; remove it") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise SlamError(f"{path}: a device or a pipe has the place of a run's own file; remove it")
    return os.fdopen(descriptor, "a+", encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object, with or without a byte order mark; SlamError when the file is anything else."""
    return _parse_json(path, _read_json_text(path).removeprefix("\ufeff"))


def parse_toml(data: bytes, *, source: str) -> dict[str, Any]:
    """Parse TOML from outside; SlamError names `source`. Keys of many parts are refused: the parser's memory grows with their square."""
    try:
        text = data.decode("utf-8-sig")
        longest = max((piece.count(".") for piece in re.split(r"[\n,=\[\]{}]", text)), default=0)
        if longest > MOST_DOTS:
            raise SlamError(f"{source}: not a configuration: a key of {longest} parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # of encoding, of syntax, of numbers with thousands of digits
        raise SlamError(f"{source}: not valid TOML: {error}") from error


def user_path(text: str | Path) -> Path:
    """Expand `~`; SlamError for a home that is not there and for a name that no file can have."""
    try:
        path = Path(text).expanduser()
        with contextlib.suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            os.stat(path)  # finds a NUL byte, a name too long, links that go round
    except (RuntimeError, ValueError, OSError) as error:
        raise SlamError(f"{str(text)[:LONGEST_NAME]!r}: not the name of a file ({error})") from error
    return path


def _read_json_text(path: Path) -> str:
    try:
        return read_bytes(path, limit=LARGEST_JSON).decode("utf-8")
    except FileNotFoundError:
        raise SlamError(f"{path}: not there") from None
    except UnicodeDecodeError as error:
        raise SlamError(f"{path}: not valid JSON") from error


def _parse_json(path: Path, text: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:  # of numbers with thousands of digits too
        raise SlamError(f"{path}: not valid JSON") from error
    if not isinstance(value, dict):
        raise SlamError(f"{path}: not a JSON object")
    return value


# digests


def sha256(path: str | Path, found: os.stat_result | None = None) -> str:
    """Digest a file's content. A file that this process has digested before and that nobody has written to since is not read again.

    found : what `os.stat` says of it now, where that has been asked
    """
    known = _known.get(version(path) if found is None else _version(found))
    if known is None:
        with open_regular(path) as file:
            known = _known[version(file.fileno())] = _content_digest(file)
    return known


def _content_digest(file: BufferedReader) -> str:
    """Digest a file past its buffer, as copying through that takes a tenth as long as to digest."""
    found, block = hashlib.sha256(), memoryview(bytearray(max(1, min(os.fstat(file.fileno()).st_size, AT_ONCE))))
    while n := file.raw.readinto(block):
        found.update(block[:n])
    return found.hexdigest()


def version(path: str | Path | int) -> tuple[int, ...]:
    """Return what changes when somebody writes to a file or replaces it; nothing where it cannot be looked at."""
    try:
        return _version(os.stat(path))
    except OSError:
        return ()


def _version(found: os.stat_result) -> tuple[int, ...]:
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def is_settled(version: tuple[int, ...]) -> bool:
    """Say whether whoever writes to a file from now on changes its version, which two writes within a tick of the clock do not."""
    return bool(version) and time.time_ns() - max(version[-2:]) > TICK_NS


def digest(value: Any) -> str:
    """Digest a JSON value, independent of the order of its keys."""
    return "sha256:" + hashlib.sha256(json.dumps(value, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def write_sealed(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON object together with its digest, so that `read_sealed` notices any change."""
    write_text(path, sealed(value), through_links=False)


def read_sealed(path: Path) -> dict[str, Any]:
    """Read what `write_sealed` wrote; SlamError when it is not there or a single bit of it is another."""
    return unsealed(_read_json_text(path), source=path)


def unsealed(text: str, *, source: Path) -> dict[str, Any]:
    """Take the JSON object out of what `sealed` gave; SlamError names `source` when a single bit of it is another.

    What its values hold is shared by all who read the same text: it is not to be changed.
    """
    try:
        value = _sealed_content(text)
    except (ValueError, RecursionError):  # of numbers with thousands of digits too
        value = None
    if value is None:
        _parse_json(source, text)
        raise SlamError(f"{source}: not as slamcli wrote it")
    return dict(value)


@functools.lru_cache(maxsize=64)  # a command reads the few records of a run again and again; parsing and writing them out anew is slow
def _sealed_content(text: str) -> dict[str, Any] | None:
    if text != _closed(text[: -len(_closed(""))]):
        return None
    value: dict[str, Any] = json.loads(text)
    value.pop(SEAL, None)
    return value


def sealed(value: Mapping[str, Any]) -> str:
    """Write a JSON object as text that ends with the digest of all before it."""
    return _closed(json.dumps({**value, SEAL: ""}, indent=1).removesuffix('"\n}'))


def _closed(text: str) -> str:
    """End the text of a JSON object, open within the string that is its last value, with the digest of that text."""
    return f'{text}sha256:{hashlib.sha256(text.encode()).hexdigest()}"\n}}\n'
