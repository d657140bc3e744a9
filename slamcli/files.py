"""Small files written whole, JSON read with suspicion, and digests."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from slamcli.errors import SlamError

LARGEST_JSON = 16 << 20  # bytes; a record is a few kB


def sha256(path: Path) -> str:
    """Digest a file's content."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def write_text(path: Path, text: str) -> None:
    """Replace a small file at once: a reader, or a power cut, meets the old text or the new."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(fresh, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(fresh, path)
    except OSError:
        fresh.unlink(missing_ok=True)
        raise


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; SlamError when the file is anything else."""
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read(LARGEST_JSON + 1)
        value = json.loads(text) if len(text) <= LARGEST_JSON else None
    except FileNotFoundError:
        raise SlamError(f"{path}: not there") from None
    except (ValueError, RecursionError) as error:
        raise SlamError(f"{path}: not valid JSON") from error
    if not isinstance(value, dict):
        raise SlamError(f"{path}: not a JSON object")
    return value
