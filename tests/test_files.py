"""Files that appear whole or not at all, sealed records, and what is refused as an input."""

import hashlib
import json
import os
import resource
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli import files
from slamcli.errors import SlamError


@contextmanager
def largest_file(n_bytes: int) -> Iterator[None]:
    """As if the disk were full after so many bytes of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_what_was_there_stays_until_all_is_written(tmp_path: Path) -> None:
    path = tmp_path / "map.pgm"
    path.write_bytes(b"old")
    with files.whole(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["map.pgm"]


def half_way(path: Path, error: BaseException) -> None:
    with files.whole(path) as file:
        file.write(b"half")
        raise error


@pytest.mark.parametrize("error", [RuntimeError("a bug"), KeyboardInterrupt(), OSError(5, "Input/output error", "elsewhere")])
def test_whatever_goes_wrong_the_earlier_file_stays_and_nothing_is_left(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"old")
    with pytest.raises(type(error)):
        half_way(path, error)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["cloud.ply"]


@pytest.mark.parametrize("limit", [0, 1, 4095, 4096, 99_999])
def test_a_full_disk_names_the_file_and_the_next_step(tmp_path: Path, limit: int) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"")
    with largest_file(limit), pytest.raises(SlamError, match=r"cloud.ply: cannot be written \(File too large; choose"):
        files.write_bytes(path, bytes(100_000))
    assert path.read_bytes() == b""
    assert os.listdir(tmp_path) == ["cloud.ply"]


def test_no_folder_and_a_folder_in_the_way_are_told(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match=r"no/x.txt: cannot be written \(its folder is not there; make it first\)"):
        files.write_text(tmp_path / "no" / "x.txt", "x")
    with pytest.raises(SlamError, match="cannot be written .Is a directory"):
        files.write_text(tmp_path, "x")


def test_a_link_stays_and_its_end_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    target, link, again = tmp_path / "far" / "map.bt", tmp_path / "latest.bt", tmp_path / "again.bt"
    link.symlink_to("far/map.bt")
    again.symlink_to("latest.bt")
    for text in ("first", "second"):  # at first it leads nowhere
        files.write_text(again, text)
        assert target.read_text() == text
    assert link.is_symlink() and again.is_symlink()
    link.unlink()
    link.symlink_to("again.bt")
    with pytest.raises(SlamError, match="Too many levels of symbolic links"):
        files.write_text(again, "round and round")


def test_a_pipe_and_a_device_are_written_to(tmp_path: Path) -> None:
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    files.write_text(pipe, "through")
    reader.join(10)
    assert got == [b"through"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    files.write_text("/dev/null", "away")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_standard_output_is_appended_to_not_replaced(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text("before\n")
    code = "from slamcli import files; files.write_text('/dev/stdout', 'now\\n'); print('after')"
    with log.open("a") as file:
        subprocess.run([sys.executable, "-c", code], stdout=file, check=True, timeout=60)
    assert log.read_text().splitlines()[-1] == "after"
    assert os.listdir(tmp_path) == ["log"]


def test_what_a_killed_process_left_is_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    code = f"from slamcli import files; import os\nwith files.whole({str(path)!r}) as file: file.write(b'half' * 9999); file.flush(); os._exit(9)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 9
    assert os.listdir(tmp_path) == [".out.txt.part"]
    files.write_text(path, "whole")
    assert os.listdir(tmp_path) == ["out.txt"]
    assert path.read_text() == "whole"


def test_two_that_write_the_same_file_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with files.whole(path) as slow:
        slow.write(b"slow " * 5000)
        with files.whole(path) as quick:
            quick.write(b"quick")
        assert path.read_text() == "quick"
        slow.write(b"end")
    assert path.read_bytes() == b"slow " * 5000 + b"end"
    assert os.listdir(tmp_path) == ["out.txt"]


def test_many_threads_on_one_name_leave_one_whole_file(tmp_path: Path) -> None:
    texts = [str(k) * (1000 + k) for k in range(8)]

    def work(text: str) -> None:
        for _ in range(20):
            files.write_text(tmp_path / "x", text)

    threads = [threading.Thread(target=work, args=(text,)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (tmp_path / "x").read_text() in texts
    assert os.listdir(tmp_path) == ["x"]


def test_a_planted_link_or_pipe_is_not_written_through(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for plant in (lambda part: part.symlink_to(victim), os.mkfifo, lambda part: part.hardlink_to(victim)):
        part = tmp_path / ".out.txt.part"
        plant(part)
        files.write_text(tmp_path / "out.txt", "mine")
        assert victim.read_text() == "precious"
        part.unlink()


def test_permissions_stay_and_a_protected_file_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_text("old")
    path.chmod(0o640)
    files.write_text(path, "new")
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    path.chmod(0o440)
    if os.geteuid():
        with pytest.raises(SlamError, match="x: cannot be written .Permission denied; choose a place you may write to"):
            files.write_text(path, "newer")
        assert path.read_text() == "new"


@pytest.mark.parametrize("name", ["n" * 255, "ü" * 127, ".hidden", "a b\n"])
def test_any_name_that_a_file_may_have(tmp_path: Path, name: str) -> None:
    files.write_text(tmp_path / name, "x")
    assert os.listdir(tmp_path) == [name]


def test_scratch_folders_of_the_dead_go_and_those_of_the_living_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = "import os, sys; from slamcli import files\nwith files.scratch('try-') as f: (f / 'x').write_text('x'); os._exit(9)"
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", code], env=environment, timeout=60)
    assert len(os.listdir(tmp_path)) == 1
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with files.scratch("try-") as first, files.scratch("try-") as second:
        assert sorted(tmp_path.iterdir()) == sorted([first, second])
    assert not os.listdir(tmp_path)


# read with suspicion


def test_only_regular_files_of_a_bounded_size_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"12345")
    assert files.read_bytes(path, limit=5) == b"12345"
    with pytest.raises(SlamError, match="too large; such a file has at most 4 bytes"):
        files.read_bytes(path, limit=4)
    (tmp_path / "zero").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    start = time.monotonic()
    for name in ("zero", "pipe", "."):
        with pytest.raises(SlamError, match="not a regular file"):
            files.read_bytes(tmp_path / name, limit=5)
    assert time.monotonic() - start < 5
    with pytest.raises(SlamError, match="not the name of a file"):
        files.read_bytes("a\0b", limit=5)


def test_what_was_digested_while_it_was_written_is_read_again_only_after_a_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "AT_ONCE", 7)
    content, path = bytes(range(50)), tmp_path / "x"
    files.write_new(path, memoryview(content[:20]), memoryview(content[20:]))
    assert path.read_bytes() == content
    with monkeypatch.context() as patch:
        patch.setattr(files, "open_regular", lambda path: pytest.fail("read again"))
        assert files.sha256(path) == hashlib.sha256(content).hexdigest()
    time.sleep(0.02)  # a file system tells times apart by its clock's ticks
    path.write_bytes(content[:-1] + b"!")
    assert files.sha256(path) == hashlib.sha256(content[:-1] + b"!").hexdigest()
    with pytest.raises(SlamError, match="cannot be written"):
        files.write_new(path, memoryview(content))  # never over what is there


def test_a_digest_follows_every_write(tmp_path: Path) -> None:
    path, seen = tmp_path / "x", set()
    for content in (b"a", b"b", b"a" * (3 << 20)):
        path.write_bytes(content)
        time.sleep(0.02)  # a file system's clock ticks every few milliseconds
        seen.add(files.sha256(path))
    assert len(seen) == 3


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(value=st.dictionaries(st.text(max_size=5), JSON, max_size=4), data=st.data())
def test_a_sealed_record_comes_back_and_no_flipped_bit_passes(
    tmp_path_factory: pytest.TempPathFactory, value: dict, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("sealed") / "run.json"
    value.pop(files.SEAL, None)
    files.write_sealed(path, value)
    assert files.read_sealed(path) == value
    assert json.loads(path.read_text()).keys() == {*value, files.SEAL}
    content = bytearray(path.read_bytes())
    bit = data.draw(st.integers(0, 8 * len(content) - 1))
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)
    with pytest.raises(SlamError, match=r"run.json: not "):
        files.read_sealed(path)


def test_a_seal_is_of_the_text_and_not_of_what_the_text_means(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    files.write_sealed(path, {"name": "caf\u00e9", "n": 1.0})
    text = path.read_text()
    assert "\\u00e9" in text
    for other in (text.replace("00e9", "00E9"), text.replace("1.0", "1.00"), text.replace(": 1", ":  1"), text.replace("\n", "\r\n")):
        assert json.loads(other) == json.loads(text)
        path.write_bytes(other.encode())
        with pytest.raises(SlamError, match="not as slamcli wrote it"):
            files.read_sealed(path)


@pytest.mark.parametrize("text", ['["', '{"a": ["', "", '{"a": {"b": "'])
def test_a_seal_does_not_make_a_record_of_what_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(files._closed(text))
    with pytest.raises(SlamError, match="run.json: not valid JSON"):
        files.read_sealed(tmp_path / "run.json")


def test_a_sealed_record_that_lost_its_end_or_its_seal_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    files.write_sealed(path, {"a": 1, "b": [2.5, None]})
    text = path.read_text()
    for spoilt in (*(text[:n] for n in range(len(text))), '{"a": 1, "b": [2.5, null]}\n', text + "\n"):
        path.write_text(spoilt)
        with pytest.raises(SlamError):
            files.read_sealed(path)
