"""Download recordings of the TUM RGB-D data set: resumable, unpacked as if the archive were hostile."""

import gzip
import http.client
import re
import shutil
import tarfile
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath

from slamcli.datasets.cameras import freiburg_number
from slamcli.datasets.staging import staged
from slamcli.errors import SlamError

BASE_URL = "https://cvg.cit.tum.de/rgbd/dataset"
CHUNK = 1 << 20
TIMEOUT = 30.0  # [s] without a byte
ATTEMPTS = 4  # a connection that breaks is taken up again where it stopped
MAX_ARCHIVE = 16 << 30  # bytes; the largest recording of the set has 6 GB
MAX_UNPACKED = 32 << 30
MOST_NAME = 255  # bytes of a member's path
MAX_MEMBERS = 200_000
MAX_READ = 64 << 20  # tarfile reads a header's claimed size at once

Progress = Callable[..., Iterable]


def download_tum(sequence: str, folder: Path, *, progress: Progress, base_url: str = BASE_URL) -> Path:
    """Fetch a recording such as ``rgbd_dataset_freiburg1_room`` into `folder`; returns the unpacked recording.

    What was loaded before a break stays as ``.part`` and is resumed; the recording's folder appears only when complete.
    """
    target = folder / sequence
    url = f"{base_url}/freiburg{freiburg_number(sequence)}/{sequence}.tgz"
    archive = folder / f"{sequence}.tgz"
    by_hand = f"or download {url} by hand and unpack it to {target}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        fetch(url, archive, progress=progress, by_hand=by_hand)
        unpack(archive, target, progress=progress)
        archive.unlink()
    except OSError as error:
        raise SlamError(f"{error.filename or folder}: cannot be written ({error.strerror or error}); {by_hand}") from error
    return target


def fetch(url: str, path: Path, *, progress: Progress, by_hand: str = "") -> None:
    """Download a file, resuming from ``<path>.part``; the file itself appears only when complete."""
    if path.exists():  # loaded before, but not yet unpacked
        return
    part = path.with_name(path.name + ".part")
    name = path.name
    for attempt in range(1, ATTEMPTS + 1):
        before = part.stat().st_size if part.exists() else 0
        try:
            for _ in _stream(url, part, progress, f"download {name} [MB]"):
                pass
            part.replace(path)
            return
        except urllib.error.HTTPError as error:
            if error.code == 404:
                raise SlamError(f"{url}: the server has no such recording (404); see {BASE_URL} for the names") from error
            if error.code == 416:  # what is on disk is longer than the file: it is not a beginning of it
                part.unlink(missing_ok=True)
            reason: object = f"HTTP status {error.code}"
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
            reason = getattr(error, "reason", None) or error
        now = part.stat().st_size if part.exists() else 0
        if now == before and attempt >= 2:  # twice nothing: off line, or the server is down
            break
    loaded = part.stat().st_size if part.exists() else 0
    kept = f"; {loaded / 1e6:.1f} MB are kept and the same command resumes" if loaded else ""
    raise SlamError(f"{url}: download failed ({reason}){kept}; try again later, {by_hand}")


def _stream(url: str, part: Path, progress: Progress, label: str) -> Iterator[int]:
    """Append what is missing to `part`, yielding the size of each chunk."""
    have = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(url, headers={"User-Agent": "slamcli", **({"Range": f"bytes={have}-"} if have else {})})
    with urllib.request.urlopen(request, timeout=TIMEOUT) as response:
        if have and not _continues(response, have):
            have = 0
        length = response.headers.get("Content-Length", "")
        total = have + int(length) if re.fullmatch("[0-9]{1,18}", length) else None
        if total is not None and total > MAX_ARCHIVE:
            raise SlamError(f"{url}: {total >> 30} GB is larger than any recording of the set")
        with part.open("ab" if have else "wb") as file:
            chunks = iter(lambda: response.read(CHUNK), b"")
            for chunk in progress(chunks, label, None if total is None else -(-(total - have) // CHUNK)):
                have += len(chunk)
                if have > MAX_ARCHIVE:
                    raise SlamError(f"{url}: sends more than {MAX_ARCHIVE >> 30} GB")
                file.write(chunk)
                yield len(chunk)
    if total is not None and have < total:
        raise ConnectionError(f"connection closed after {have} of {total} bytes")


def _continues(response: http.client.HTTPResponse, have: int) -> bool:
    """Say whether the answer starts at byte `have`; servers may ignore a range and send all."""
    found = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    return response.status == 206 and found is not None and int(found.group(1)) == have


def unpack(archive: Path, target: Path, *, progress: Progress) -> None:
    """Unpack a .tgz whose members all lie in one folder named like `target`; complete or not at all.

    Only plain files and folders inside that folder are accepted: links, devices, paths that lead out and sizes beyond reason make the
    archive refused. A damaged archive is removed, so that the next attempt loads it anew.
    """
    if target.exists():
        raise SlamError(f"{target}: exists already; remove it or use it")
    try:
        with staged(target) as staging, gzip.open(archive) as stream:
            with tarfile.open(fileobj=_Bounded(stream), mode="r:") as tar:  # type: ignore[call-overload]  # it has what tarfile calls: read, seek, tell
                _extract(tar, staging, target.name, progress)
            _drain(stream)
    except (tarfile.TarError, gzip.BadGzipFile, EOFError, ValueError, zlib.error) as error:
        archive.unlink(missing_ok=True)
        raise SlamError(f"{archive}: damaged archive ({error}), removed; run the command again to load it anew") from error
    except SlamError:
        archive.unlink(missing_ok=True)
        raise


def _extract(tar: tarfile.TarFile, staging: Path, top: str, progress: Progress) -> None:
    total = 0
    for count, member in enumerate(progress(tar, f"unpack {top} [files]", None), start=1):
        total += member.size
        if count > MAX_MEMBERS or total > MAX_UNPACKED:
            raise SlamError(f"{top}: archive refused: unpacks to more than any recording of the set holds")
        inside = _inside(member, top)
        path = staging.joinpath(*inside.parts)
        try:
            (path if member.isdir() else path.parent).mkdir(parents=True, exist_ok=True)
            if member.isdir():
                continue
            source = tar.extractfile(member)
            with path.open("xb") as file:
                shutil.copyfileobj(source, file, CHUNK)  # type: ignore[arg-type]  # a plain file's is never None
        except (FileExistsError, NotADirectoryError) as error:
            raise SlamError(f"archive refused: {member.name!r} is in it twice, or within one of its files") from error


def _drain(stream: gzip.GzipFile) -> None:
    """Read on to the end of the archive, where its checksum is compared; tar stops at its own end mark."""
    left = MAX_READ
    while chunk := stream.read(CHUNK):
        left -= len(chunk)
        if left < 0:
            raise SlamError("archive refused: goes on long after its last file")


def _inside(member: tarfile.TarInfo, top: str) -> PurePosixPath:
    """Return a member's path below the top folder; SlamError for whatever a recording does not consist of."""
    path = PurePosixPath(member.name)
    harmless = not path.is_absolute() and ".." not in path.parts and "\\" not in member.name and ":" not in member.name
    plain = member.type in (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.DIRTYPE)
    is_short = len(member.name.encode(errors="surrogateescape")) <= MOST_NAME
    if not harmless or not plain or not is_short or path.parts[:1] != (top,):
        raise SlamError(f"archive refused: {member.name!r} is not a plain file or folder inside {top}")
    return path.relative_to(top)


class _Bounded:
    """A stream that refuses to hand out absurd amounts at once, as a forged header would have tarfile ask for."""

    def __init__(self, stream: gzip.GzipFile) -> None:
        self._stream = stream
        self.seek, self.tell = stream.seek, stream.tell

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= MAX_READ:
            raise SlamError(f"archive refused: a header claims {size} bytes")
        return self._stream.read(size)
