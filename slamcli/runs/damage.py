"""What a run's files are checked against, and what those of them that no stage can make again are restored from."""

import functools
import hashlib
import os
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from slamcli import files
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.errors import Damaged, SlamError
from slamcli.hints import hint
from slamcli.schema import FORMAT

Records = Mapping[str, Mapping[str, Any]]  # stage.json by stage

SEAL = "# sealed "  # begins the last line of config.toml; the digest of all above it follows
MOST_RECORDS = 64  # kept; a run has eight
RECORD_KEYS: dict[str, Any] = {
    "stage": str,
    "config": dict,
    "inputs": dict,
    "outputs": dict,
    "digest": str,
    "environment": dict,
    "seconds": (int, float),
    "cpu_seconds": (int, float),
    "compile_seconds": (int, float),
    "fps": (int, float, type(None)),
    "peak_rss_mb": (int, float),
    "summary": dict,
    "warnings": list,
    "n_warnings": int,
    "code": dict,
    "reader": str,
}

_records: dict[tuple[int, ...], dict[str, Any]] = {}  # by what changes when a file does: each is asked for dozens of times a run


def read_record(path: Path) -> dict[str, Any]:
    """Read a ``stage.json``; SlamError when it cannot be what this program wrote. One that nobody has written to since is not read again."""
    version = files.version(path)
    if version in _records:
        return dict(_records[version])
    record = files.read_sealed(path)
    if "format" not in record or (record["format"] == FORMAT and not is_record(record)):
        raise SlamError(f"{path}: not a stage's record")
    if files.is_settled(version):
        if len(_records) >= MOST_RECORDS:
            _records.clear()
        _records[version] = record
    return dict(record)


def is_record(record: Mapping[str, Any]) -> bool:
    """Say whether a ``stage.json`` has all that a stage's record has."""
    if not all(name in record and isinstance(record[name], kind) for name, kind in RECORD_KEYS.items()):
        return False
    if "slamcli" not in record["environment"]:
        return False
    entries = record["outputs"].values()
    return all(isinstance(e, dict) and isinstance(e.get("bytes"), int) and isinstance(e.get("sha256"), str) for e in entries)


def outputs(folder: Path) -> dict[str, dict[str, Any]]:
    """List a stage's files with size and digest, by name."""
    paths = sorted(os.path.join(home, name) for home, _, names in os.walk(folder) for name in names if name != "stage.json")
    found = {path: os.stat(path) for path in paths}
    return {
        os.path.relpath(path, folder).replace(os.sep, "/"): {"bytes": status.st_size, "sha256": files.sha256(path, status)}
        for path, status in found.items()
        if stat.S_ISREG(status.st_mode)
    }


def find(folder: Path, outputs: Mapping[str, Any], names: Iterable[str], *, verify: bool) -> str:
    """Say what is wrong with files of a stage's folder, or "": each has its recorded size and, with `verify`, its recorded digest."""
    home = os.fspath(folder)
    for name in names:
        path, entry = os.path.join(home, name), outputs[name]
        try:
            found = os.stat(path)  # once: a run has a hundred files, and they are looked at before each stage
        except (FileNotFoundError, NotADirectoryError):
            found = None
        if found is None or not stat.S_ISREG(found.st_mode):
            return f"{folder.name}/{name} is not there"
        if found.st_size != entry["bytes"]:
            return f"{folder.name}/{name} has {found.st_size} bytes, {entry['bytes']} recorded"
        if verify and files.sha256(path, found) != entry["sha256"]:
            return f"{folder.name}/{name} has other content than recorded"
    return ""


def write_config(path: Path, config: Config) -> None:
    """Write a configuration that `read_config` finds unchanged."""
    text = toml.dump(config).encode()
    files.write_bytes(path, text + seal(text), through_links=False)


def read_config(path: Path) -> Config:
    """Read a run's configuration; Damaged when a single bit of it is another than when it was written.

    A file cut short may still be valid TOML, and would silently fall back to the defaults.
    """
    return _sealed_config(files.read_bytes(path, limit=toml.LARGEST_FILE), str(path))


@functools.lru_cache(maxsize=8)  # every step of a command asks for it
def _sealed_config(data: bytes, source: str) -> Config:
    text = data[: data.rfind(SEAL.encode())] if SEAL.encode() in data else b""
    if text + seal(text) != data:
        raise Damaged(
            f"{source}: not as slamcli wrote it; restore it from what the stages recorded with: {hint().repair(Path(source).parent)}; "
            f"give your changes with {hint().argument('settings')} or {hint().argument('config')}"
        )
    try:
        return toml.parse(text, source=source)
    except SlamError as error:  # it is whole, so that it is not the user's slip
        raise _of_another_version(error) from error


def _of_another_version(error: SlamError) -> SlamError:
    return SlamError(f"{error} (another version of slamcli made this run; start another one with {hint().argument('path')})")


def seal(text: bytes) -> bytes:
    """Return the last line of a configuration, which holds the digest of all above it."""
    return f"{SEAL}{hashlib.sha256(text).hexdigest()}\n".encode()


def restored_config(records: Records) -> Config:
    """Put the configuration together that the stages ran with, those that ran last having the last word; else the defaults."""
    config = Config()
    for stage, record in records.items():
        try:
            config = toml.merge(config, record["config"], source=f"{stage}/stage.json")
        except SlamError as error:
            raise _of_another_version(error) from error
    return config


def restored_info(records: Records) -> dict[str, Any]:
    """Return the name, the folder and the digest of the recording that the stages read, and of several which they are; nothing where none recorded it."""
    for record in reversed(list(records.values())):
        recording = record.get("recording", {})
        if "dataset" in record["inputs"] and {"dataset", "root"} <= recording.keys():
            return {**recording, "digest": record["inputs"]["dataset"]}
    return {}
