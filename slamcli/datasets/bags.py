"""ROS bags of all kinds as lists of messages that can be read one by one: ROS 1 .bag, ROS 2 SQLite and MCAP.

The `rosbags` package finds what is in a bag; messages are then read at their place in the file, so that opening costs an index and no
more memory than that. Parts that are packed are unpacked whole, the last few are kept.
"""

import os
import sqlite3
import struct
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from slamcli.datasets.sqlite import Connections, check_stored
from slamcli.errors import BadFrame, SlamError

HEAD = 64  # bytes of a message that hold its stamp
KEPT = 3  # unpacked parts of a file
MAX_MESSAGE = 256 << 20  # bytes
MAX_UNPACKED = 1 << 30  # bytes of one part
MOST_PACKED = 3 << 30  # bytes of packed parts up to which all are unpacked for the stamps of their messages


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    kind: str  # such as "sensor_msgs/msg/Image"
    messages: list[tuple[int, Any]] = field(repr=False)  # (time of recording [ns], where the message is)


class Bag(Protocol):
    """Messages by topic."""

    is_cdr: bool  # ROS 2's serialization, else ROS 1's
    topics: dict[str, Topic]
    is_slow: bool  # to read a message's first bytes costs as much as to read it, and there are many

    def read(self, place: Any, n: int | None = None) -> bytes:
        """Read a message, or its first n bytes at least; BadFrame where it is damaged."""


def open_bag(path: Path) -> Bag:
    """Open a bag; SlamError says what is wrong with it."""
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error

    try:
        return _bag1(path) if path.suffix.lower() == ".bag" else _bag2(path)
    except SlamError:
        raise
    except (Reader1Error, Reader2Error) as error:
        advice = "; repair it with `rosbag reindex`" if "not indexed" in str(error) else "; is it cut off, or still being recorded?"
        raise SlamError(f"{path}: cannot be read as a bag: {_one_line(error)}{advice}") from error
    except Exception as error:  # the package meets hostile bytes with assertions and whatever its parsers raise
        raise SlamError(f"{path}: cannot be read as a bag; is it cut off? ({type(error).__name__}: {_one_line(error)})") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def _bag1(path: Path) -> "Bag1":
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        return Bag1(path, reader)


def _bag2(path: Path) -> "Bag2":
    """Put the files of a ROS 2 bag together. A reader that unpacked whole files stays open, as they vanish with it."""
    from rosbags.rosbag2 import Reader

    reader = Reader(path)
    with _checked_databases():
        reader.open()
    is_unpacked = False
    try:
        storages = list(getattr(reader.storage, "storages", [reader.storage]))
        mode = getattr(reader, "compression_mode", None)
        is_unpacked = mode == "file"
        parts: list[Any] = [McapFile(s) if type(s).__name__ == "McapReader" else SqliteFile(s) for s in storages]
        if not parts:
            raise SlamError(f"{path}: names no file with messages")
        bag = Bag2(path, parts, is_packed=mode == "message")
    except BaseException:
        is_unpacked = False
        raise
    finally:
        if not is_unpacked:
            reader.close()
    if is_unpacked:
        weakref.finalize(bag, reader.close)
    return bag


@contextmanager
def _checked_databases() -> Iterator[None]:
    """Have each SQLite file that the package opens within the block checked before it is asked anything."""
    import apsw

    def check(connection: Any) -> None:
        check_stored(connection.execute, Path(connection.filename))

    apsw.connection_hooks.append(check)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(check)


class _Parts:
    """A file whose parts may be packed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = os.open(path, os.O_RDONLY)
        self._size = os.fstat(self._file).st_size
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, bytes] = OrderedDict()

    def __del__(self) -> None:
        os.close(self._file)

    def at(self, start: int, n: int) -> bytes:
        """Read n bytes at a place in the file, fewer at its end."""
        return os.pread(self._file, min(n, self._size - start), start) if 0 <= start < self._size and n > 0 else b""

    def unpacked(self, key: int, unpack: Callable[[], bytes]) -> bytes:
        """Return a part, unpacked once for messages that follow each other."""
        with self._lock:
            if key not in self._kept:
                try:
                    part = unpack()
                except BadFrame:
                    raise
                except Exception as error:  # each packing has an error of its own
                    raise BadFrame(f"{self.path}: the part at byte {key} is damaged ({error})") from error
                if len(part) > MAX_UNPACKED:
                    raise BadFrame(f"{self.path}: the part at byte {key} is too large")
                self._kept[key] = part
                while len(self._kept) > KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]


class Bag1:
    """ROS 1: chunks, an index for each."""

    is_cdr = False

    def __init__(self, path: Path, reader: Any) -> None:
        self.path, self._parts = path, _Parts(path)
        self._chunks = dict(reader.chunks)
        plain = _plain_decompressor(reader)
        self._packed = {pos for pos, chunk in self._chunks.items() if chunk.decompressor is not plain}
        self.is_slow = sum(self._chunks[pos].datasize for pos in self._packed) > MOST_PACKED
        self.topics: dict[str, Topic] = {}
        for connection in reader.connections:
            messages = [(entry.time, (entry.chunk_pos, entry.offset)) for entry in reader.indexes[connection.id]]
            before = self.topics.get(connection.topic)
            if before is not None:
                messages = sorted(before.messages + messages)
            self.topics[connection.topic] = Topic(connection.topic, connection.msgtype, messages)

    def read(self, place: tuple[int, int], n: int | None = None) -> bytes:
        """Read the record at an offset of a chunk; records of connections before it are passed over."""
        pos, offset = place
        chunk = self._chunks[pos]
        take = self._part(pos) if pos in self._packed else lambda start, size: self._parts.at(chunk.datapos + start, size)
        for _ in range(64):
            head = take(offset, 4096)
            try:
                (length,) = struct.unpack_from("<I", head)
                if length > len(head) - 8:
                    break
                (size,) = struct.unpack_from("<I", head, 4 + length)
            except struct.error:
                break
            start = 8 + length
            if b"op=\x02" in head[4 : 4 + length]:
                return self._message(take, head, offset, start, size, n)
            offset += start + size
        raise BadFrame(f"{self.path}: the message at byte {pos} + {offset} is damaged")

    def _message(self, take: Callable[[int, int], bytes], head: bytes, offset: int, start: int, size: int, n: int | None) -> bytes:
        wanted = size if n is None else min(n, size)
        if size > MAX_MESSAGE:
            raise BadFrame(f"{self.path}: a message of {size >> 20} MB is too large")
        data = head[start : start + wanted] if start + wanted <= len(head) else take(offset + start, wanted)
        if len(data) < wanted:
            raise BadFrame(f"{self.path}: is cut off")
        return data

    def _part(self, pos: int) -> Callable[[int, int], bytes]:
        chunk = self._chunks[pos]
        part = self._parts.unpacked(pos, lambda: chunk.decompressor(self._parts.at(chunk.datapos, chunk.datasize)))
        return lambda start, size: part[start : start + size]


def _plain_decompressor(reader: Any) -> Any:
    from rosbags.rosbag1 import reader as module

    return module.decompressors["none"]


class Bag2:
    """ROS 2: one or more files."""

    is_cdr = True

    def __init__(self, path: Path, parts: list[Any], *, is_packed: bool) -> None:
        self.path, self._files, self._is_packed = path, parts, is_packed
        self.is_slow = any(part.is_slow for part in parts)
        found: dict[str, tuple[str, list[tuple[int, Any]]]] = {}
        for number, part in enumerate(parts):
            for name, kind, messages in part.topics():
                found.setdefault(name, (kind, []))[1].extend((time, (number, place)) for time, place in messages)
        self.topics = {name: Topic(name, kind, sorted(messages, key=lambda m: m[0])) for name, (kind, messages) in found.items()}

    def read(self, place: tuple[int, Any], n: int | None = None) -> bytes:
        """Read a message of one of the files."""
        data = self._files[place[0]].read(place[1], None if self._is_packed else n)
        if not self._is_packed:
            return data
        from backports import zstd

        try:
            return zstd.ZstdDecompressor().decompress(data, n if n is not None else MAX_MESSAGE)
        except zstd.ZstdError as error:
            raise BadFrame(f"{self.path}: a message is damaged ({error})") from error


class SqliteFile:
    """One .db3 file; its first bytes are read through SQLite's handle for single values."""

    is_slow = False

    def __init__(self, storage: Any) -> None:
        self.path = Path(storage.path)
        self._kinds = {c.id: (c.topic, c.msgtype) for c in storage.connections}
        self._connections = Connections(self.path)

    def topics(self) -> list[tuple[str, str, list[tuple[int, int]]]]:
        """List the messages of each topic."""
        found = []
        for key, (topic, kind) in self._kinds.items():
            rows = self._connections.of_this_thread().execute(
                "SELECT timestamp, id FROM messages WHERE topic_id = ? ORDER BY timestamp", (key,)
            )
            found.append((topic, kind, [(int(time), int(row)) for time, row in rows]))
        return found

    def read(self, row: int, n: int | None = None) -> bytes:
        """Read a message or its beginning."""
        try:
            with self._connections.of_this_thread().blobopen("messages", "data", row, readonly=True) as blob:
                if len(blob) > MAX_MESSAGE:
                    raise BadFrame(f"{self.path}: a message of {len(blob) >> 20} MB is too large")
                return blob.read(-1 if n is None else n)
        except sqlite3.Error as error:
            raise BadFrame(f"{self.path}: message {row} is damaged ({error})") from error


class McapFile:
    """One .mcap file: chunks with an index for each, or none at all."""

    def __init__(self, storage: Any) -> None:
        self.path = Path(storage.path)
        self._parts = _Parts(self.path)
        self._channels = {c.id: (c.topic, c.msgtype) for c in storage.connections}
        self._range = storage.data_start, storage.data_end
        self._chunks = {chunk.chunk_start_offset: chunk for chunk in storage.chunks}
        packed = [chunk.compressed_size for chunk in self._chunks.values() if chunk.compression]
        self.is_slow = sum(packed) > MOST_PACKED

    def topics(self) -> list[tuple[str, str, list[tuple[int, tuple[int, int]]]]]:
        """List the messages of each topic."""
        channels = self._channels
        found: dict[int, list[tuple[int, tuple[int, int]]]] = {key: [] for key in channels}
        if self._chunks and all(chunk.message_index_offsets for chunk in self._chunks.values()):
            for chunk in self._chunks.values():
                for channel, offset in chunk.message_index_offsets.items():
                    if channel in found:
                        found[channel] += [(time, (chunk.chunk_start_offset, at)) for time, at in self._index(offset)]
        else:
            self._scan(found)
        return [(*channels[key], sorted(messages)) for key, messages in found.items()]

    def read(self, place: tuple[int, int], n: int | None = None) -> bytes:
        """Read the record at an offset of a chunk, or of the file."""
        start, offset = place
        chunk = self._chunks.get(start)
        if chunk is None:
            take: Callable[[int, int], bytes] = lambda at, size: self._parts.at(at, size)  # noqa: E731
        else:
            data_at = start + 9 + 40 + len(chunk.compression)
            if chunk.compression:
                part = self._parts.unpacked(start, lambda: self._unpack(chunk, data_at))
                take = lambda at, size: part[at : at + size]  # noqa: E731
            else:
                take = lambda at, size: self._parts.at(data_at + at, size)  # noqa: E731
        head = take(offset, 31)
        if len(head) < 31 or head[0] != 5:
            raise BadFrame(f"{self.path}: the message at byte {start} + {offset} is damaged")
        size = struct.unpack_from("<Q", head, 1)[0] - 22
        if not 0 <= size <= MAX_MESSAGE:
            raise BadFrame(f"{self.path}: a message of {size >> 20} MB is too large")
        wanted = size if n is None else min(n, size)
        data = take(offset + 31, wanted)
        if len(data) < wanted:
            raise BadFrame(f"{self.path}: is cut off")
        return data

    def _unpack(self, chunk: Any, data_at: int) -> bytes:
        from rosbags.rosbag2.storage_mcap import decompress

        if chunk.uncompressed_size > MAX_UNPACKED:
            raise BadFrame(f"{self.path}: a chunk of {chunk.uncompressed_size >> 20} MB is too large")
        return decompress(self._parts.at(data_at, chunk.compressed_size), chunk.compression, chunk.uncompressed_size, 0)

    def _index(self, offset: int) -> list[tuple[int, int]]:
        """Read one index record: (time, offset in the chunk) of each message."""
        head = self._parts.at(offset, 15)
        if len(head) < 15 or head[0] != 7:
            raise SlamError(f"{self.path}: its index is damaged; repair it with `mcap recover`")
        (size,) = struct.unpack_from("<I", head, 11)
        return list(struct.iter_unpack("<QQ", self._parts.at(offset + 15, size // 16 * 16)))

    def _scan(self, found: dict[int, list[tuple[int, tuple[int, int]]]]) -> None:
        """Find messages without an index by walking over the file."""
        at, end = self._range
        while at + 9 <= end:
            head = self._parts.at(at, 31)
            (size,) = struct.unpack_from("<Q", head, 1)
            if head[0] == 5 and len(head) == 31:
                channel, _, time = struct.unpack_from("<HIQ", head, 9)
                if channel in found:
                    found[channel].append((time, (-1, at)))
            elif head[0] == 6:
                raise SlamError(f"{self.path}: has no index of its messages; repair it with `mcap recover`")
            at += 9 + size
