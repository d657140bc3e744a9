"""Downloading from a server on the loopback that behaves well or badly, and unpacking archives that do."""

import gzip
import http.server
import io
import tarfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from slamcli.datasets import download, silent
from slamcli.datasets.download import download_tum, fetch, unpack
from slamcli.errors import SlamError

NAME = "rgbd_dataset_freiburg1_test"
PATH = f"/freiburg1/{NAME}.tgz"


@dataclass
class Server:
    """What the server has, how it misbehaves, and what it was asked."""

    url: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    cut_after: list[int] = field(default_factory=list)  # per request: close after so many bytes
    honours_range: bool = True
    status: int = 0
    ranges: list[str | None] = field(default_factory=list)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    state = Server()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range")
            state.ranges.append(wanted)
            body = state.files.get(self.path)
            if state.status or body is None:
                self.send_error(state.status or 404)
                return
            start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted and state.honours_range else 0
            if start >= len(body):
                self.send_error(416)
                return
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(body) - 1}/{len(body)}")
            self.send_header("Content-Length", str(len(body) - start))
            self.end_headers()
            rest = body[start:]
            self.wfile.write(rest[: state.cut_after.pop(0)] if state.cut_after else rest)

        def log_message(self, *_: object) -> None:
            pass

    httpd = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    state.url = f"http://127.0.0.1:{httpd.server_port}"
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    try:
        yield state
    finally:
        httpd.shutdown()
        thread.join()
        httpd.server_close()


def member(name: str, kind: bytes = tarfile.REGTYPE, size: int = 0, target: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.size, info.linkname = kind, size, target
    return info


def archive(*members: tuple[tarfile.TarInfo, bytes]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as tar:
        for info, data in members:
            info.size = info.size or len(data)
            tar.addfile(info, io.BytesIO(data))
    return stream.getvalue()


SOUND = archive(
    (member(NAME, tarfile.DIRTYPE), b""),
    (member(f"{NAME}/rgb.txt"), b"0.0 rgb/0.png\n"),
    (member(f"{NAME}/rgb/0.png"), bytes(range(256)) * 5000),
)


def is_sound(folder: Path) -> bool:
    return (folder / "rgb.txt").read_bytes() == b"0.0 rgb/0.png\n" and (folder / "rgb/0.png").stat().st_size == 256 * 5000


def left_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_complete_download_leaves_the_recording_alone(server: Server, tmp_path: Path) -> None:
    server.files[PATH] = SOUND
    seen: list[str] = []

    def progress(items: object, label: str, total: int | None = None) -> object:
        seen.append(label)
        return items

    folder = download_tum(NAME, tmp_path / "tum", progress=progress, base_url=server.url)
    assert folder == tmp_path / "tum" / NAME and is_sound(folder)
    assert left_in(tmp_path / "tum") == [NAME]
    assert seen == [f"download {NAME}.tgz [MB]", f"unpack {NAME} [files]"]


def test_broken_connection_is_taken_up_where_it_stopped(server: Server, tmp_path: Path) -> None:
    server.files[PATH], server.cut_after = SOUND, [1000, 500]
    assert is_sound(download_tum(NAME, tmp_path, progress=silent, base_url=server.url))
    assert server.ranges == [None, "bytes=1000-", "bytes=1500-"]


def test_a_later_call_resumes_what_an_earlier_one_left(server: Server, tmp_path: Path) -> None:
    server.files[PATH], server.cut_after = SOUND, [1000, 0, 0, 0, 0]
    with pytest.raises(SlamError, match=r"0\.0 MB are kept and the same command resumes"):
        download_tum(NAME, tmp_path, progress=silent, base_url=server.url)
    assert left_in(tmp_path) == [f"{NAME}.tgz.part"]
    server.cut_after.clear()
    assert is_sound(download_tum(NAME, tmp_path, progress=silent, base_url=server.url))
    assert server.ranges[-1] == "bytes=1000-"


def test_server_that_ignores_ranges_sends_all_again(server: Server, tmp_path: Path) -> None:
    server.files[PATH], server.cut_after, server.honours_range = SOUND, [1000], False
    assert is_sound(download_tum(NAME, tmp_path, progress=silent, base_url=server.url))


def test_left_over_longer_than_the_file_is_dropped(server: Server, tmp_path: Path) -> None:
    server.files[PATH] = SOUND
    (tmp_path / f"{NAME}.tgz.part").write_bytes(bytes(len(SOUND) + 10))
    assert is_sound(download_tum(NAME, tmp_path, progress=silent, base_url=server.url))


def test_unknown_recording_and_server_trouble(server: Server, tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="no such recording"):
        download_tum(NAME, tmp_path, progress=silent, base_url=server.url)
    server.status = 503
    with pytest.raises(SlamError, match=r"503.*download .* by hand and unpack it to"):
        download_tum(NAME, tmp_path, progress=silent, base_url=server.url)
    assert left_in(tmp_path) == []


def test_off_line_says_where_to_put_a_manual_download(tmp_path: Path) -> None:
    with pytest.raises(SlamError) as caught:
        download_tum(NAME, tmp_path, progress=silent, base_url="http://127.0.0.1:9")
    text = str(caught.value)
    assert f"http://127.0.0.1:9{PATH}" in text and str(tmp_path / NAME) in text and "\n" not in text


def test_truncated_archive_is_removed_and_loaded_anew(server: Server, tmp_path: Path) -> None:
    server.files[PATH] = SOUND[: len(SOUND) // 2]
    with pytest.raises(SlamError, match="damaged archive"):
        download_tum(NAME, tmp_path, progress=silent, base_url=server.url)
    assert left_in(tmp_path) == []
    server.files[PATH] = SOUND
    assert is_sound(download_tum(NAME, tmp_path, progress=silent, base_url=server.url))


def test_interrupted_unpacking_leaves_no_recording(server: Server, tmp_path: Path) -> None:
    server.files[PATH] = SOUND

    def interrupt(items: Iterator, label: str, total: int | None = None) -> Iterator:
        for item in items:
            yield item
            if label.startswith("unpack"):
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download_tum(NAME, tmp_path, progress=interrupt, base_url=server.url)
    assert left_in(tmp_path) == [f"{NAME}.tgz"]
    server.files.clear()  # the archive is not loaded a second time
    assert is_sound(download_tum(NAME, tmp_path, progress=silent, base_url=server.url))


def test_no_write_permission_is_told(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(SlamError, match="cannot be written"):
        download_tum(NAME, tmp_path / "file" / "tum", progress=silent, base_url=server.url)


def test_too_large_a_file_is_not_even_begun(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server.files["/x"] = bytes(5000)
    monkeypatch.setattr(download, "MAX_ARCHIVE", 4999)
    with pytest.raises(SlamError, match="larger than any"):
        fetch(server.url + "/x", tmp_path / "x", progress=silent)
    assert left_in(tmp_path) == []


HOSTILE: dict[str, Callable[[], bytes]] = {
    "parent": lambda: archive((member(f"{NAME}/../../evil"), b"x")),
    "absolute": lambda: archive((member("/tmp/evil"), b"x")),
    "outside": lambda: archive((member("other/evil"), b"x")),
    "backslash": lambda: archive((member(f"{NAME}\\..\\evil"), b"x")),
    "drive": lambda: archive((member(f"{NAME}/C:evil"), b"x")),
    "symbolic link": lambda: archive((member(f"{NAME}/l", tarfile.SYMTYPE, target="/etc"), b""), (member(f"{NAME}/l/evil"), b"x")),
    "hard link": lambda: archive((member(f"{NAME}/l", tarfile.LNKTYPE, target="/etc/passwd"), b"")),
    "device": lambda: archive((member(f"{NAME}/d", tarfile.CHRTYPE), b"")),
    "pipe": lambda: archive((member(f"{NAME}/p", tarfile.FIFOTYPE), b"")),
    "twice": lambda: archive((member(f"{NAME}/a"), b"x"), (member(f"{NAME}/a"), b"y")),
    "within a file": lambda: archive((member(f"{NAME}/a"), b"x"), (member(f"{NAME}/a/b/c"), b"y")),
    "a folder in the place of a file": lambda: archive((member(f"{NAME}/a"), b"x"), (member(f"{NAME}/a", tarfile.DIRTYPE), b"")),
    "long name": lambda: archive((member(f"{NAME}/{'a' * 300}"), b"x")),
    "size": lambda: gzip.compress(member(f"{NAME}/huge", size=1 << 45).tobuf(tarfile.GNU_FORMAT)),
    "header": lambda: gzip.compress(member("x", tarfile.XHDTYPE, size=1 << 40).tobuf(tarfile.GNU_FORMAT)),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_archives_are_refused_whole(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "inner" / f"{NAME}.tgz"
    path.parent.mkdir()
    path.write_bytes(HOSTILE[kind]())
    with pytest.raises(SlamError, match="archive refused"):
        unpack(path, path.parent / NAME, progress=silent)
    assert left_in(path.parent) == [] and left_in(tmp_path) == ["inner"]


@pytest.mark.parametrize(
    "data",
    [b"", b"<html>", gzip.compress(b"no tar" * 1000), SOUND[:-20], SOUND[:300] + bytes(50) + SOUND[350:]],
    ids=["empty", "a page", "no tar inside", "cut off", "a hole"],
)
def test_damaged_archives_are_told_and_removed(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / f"{NAME}.tgz"
    path.write_bytes(data)
    with pytest.raises(SlamError, match="damaged archive"):
        unpack(path, tmp_path / NAME, progress=silent)
    assert left_in(tmp_path) == []


def test_too_many_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "MAX_MEMBERS", 2)
    path = tmp_path / f"{NAME}.tgz"
    path.write_bytes(SOUND)
    with pytest.raises(SlamError, match="more than any recording"):
        unpack(path, tmp_path / NAME, progress=silent)
