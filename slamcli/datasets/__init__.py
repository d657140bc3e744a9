"""Recordings: find one by name, recognize its layout, open it."""

import os
import re
from pathlib import Path
from typing import Any

from slamcli.config.options import RecordingConfig
from slamcli.console import Progress, silent
from slamcli.datasets.assembly import assemble
from slamcli.datasets.protocol import Dataset
from slamcli.datasets.readers import READERS, reader_of
from slamcli.datasets.unknown_folder import describe
from slamcli.errors import SlamError
from slamcli.files import user_path
from slamcli.hints import hint
from slamcli.user_cache import user_cache

__all__ = ["READERS", "Dataset", "open_dataset", "silent"]

DEMO = "demo"
FILES = (".bag", ".db", ".db3", ".mcap", ".mkv", ".r3d", ".sens")  # that may be recordings by themselves
ARCHIVES = (".zip", ".gz", ".tgz", ".tar", ".7z", ".rar", ".bz2", ".xz")

# Names of the literature for recordings whose folders are called otherwise.
ALIASES = {
    "fr3_office": "rgbd_dataset_freiburg3_long_office_household",
    "fr3_nst": "rgbd_dataset_freiburg3_nostructure_texture_near_withloop",
}


def open_dataset(
    target: str,
    *,
    data: str | None = None,
    camera: dict[str, Any] | None = None,
    options: RecordingConfig | None = None,
    progress: Progress = silent,
) -> Dataset:
    """Open a recording.

    target : a folder or file, ``tum/fr1_room`` (or ``tum/rgbd_dataset_freiburg1_room``), or ``demo``
    data : folder to look in first; then $SLAMCLI_DATA, ./data and the user's cache
    camera : intrinsics that replace those found
    options : which part of it to use, and what it is where it does not say so itself

    A recording of the TUM set that is nowhere is downloaded into the cache, the demo is rendered into it, both once.
    """
    path, name = _locate(str(target), data, progress)
    reader = reader_of(path)
    if reader is None:
        raise SlamError(_not_a_recording(path))
    return assemble(reader.layout.read(path), name=name, camera=camera, options=options)


def _not_a_recording(path: Path) -> str:
    if path.suffix.lower() in ARCHIVES:
        return f"{path}: an archive; unpack it and give the folder of the recording"
    if path.is_file():
        return f"{path}: not a recording; give the folder of one, or a file of a kind that opens (see: {hint().layouts()})"
    if not path.is_dir():
        return f"{path}: a device or a pipe; give the folder of a recording, or a file of a kind that opens (see: {hint().layouts()})"
    entries = (entry for entry in sorted(path.iterdir()) if entry.is_dir() or entry.suffix.lower() in FILES)
    inner = [entry.name for entry in entries if reader_of(entry) is not None]
    seen = "" if inner else describe(path)
    found = f"; recordings are in it: {', '.join(inner[:3])}" if inner else f"; {seen}" if seen else ""
    return f"{path}: not a recording{found}; see what opens and how it is told: {hint().layouts()}"


def _locate(target: str, data: str | None, progress: Progress) -> tuple[Path, str]:
    """Return (folder, name), downloading or rendering what is not there."""
    if target == DEMO:
        from slamcli.datasets.demo import demo_folder

        return demo_folder(user_cache(), progress=progress), DEMO
    if not target.strip():
        raise SlamError("no recording named; give a folder, tum/fr1_room or demo")
    path = user_path(target)
    if path.exists():
        return path, _name_of(path)
    roots = _data_roots(data)
    candidates = [root / variant for root in roots for variant in _variants(target)]
    for candidate in candidates:
        if candidate.exists():
            return candidate, _name_of(candidate)
    sequence = _tum_sequence(target)
    if sequence is None:
        looked = ", ".join(str(root) for root in roots)
        raise SlamError(f"{target}: no such recording; looked for this folder itself and under {looked}")
    from slamcli.datasets.download import download_tum

    folder = download_tum(sequence, user_cache() / "datasets" / "tum", progress=progress)
    return folder, _name_of(folder)


def _data_roots(data: str | None) -> list[Path]:
    if data is not None and not user_path(data).is_dir():
        raise SlamError(f"{hint().argument('data')} {data}: no such folder")
    given = [data, os.environ.get("SLAMCLI_DATA"), "data"]
    return [user_path(root) for root in given if root] + [user_cache() / "datasets"]


def _variants(target: str) -> list[str]:
    """Return the folders below a data root that a name can mean; the root may be the folder `tum` itself."""
    sequence = _tum_sequence(target)
    names = [target] if not Path(target).is_absolute() else []
    for form in [sequence, _short(sequence)] if sequence else []:
        names += [f"tum/{form}", form]
    return names


def _tum_sequence(target: str) -> str | None:
    """Return the full name of a TUM sequence from any of its forms, None for what is none."""
    short = target.removeprefix("tum/")
    if short in ALIASES:
        return ALIASES[short]
    found = re.fullmatch(r"(?:rgbd_dataset_)?(?:freiburg|fr)([123])_([A-Za-z0-9_]+)", short)
    return f"rgbd_dataset_freiburg{found.group(1)}_{found.group(2)}" if found else None


def _short(sequence: str) -> str:
    short_of = {full: alias for alias, full in ALIASES.items()}
    return short_of.get(sequence, sequence.replace("rgbd_dataset_freiburg", "fr"))


def _name_of(folder: Path) -> str:
    """Return the name of a recording, fit for a folder below runs/."""
    name = folder.resolve().stem if folder.is_file() else folder.resolve().name
    sequence = _tum_sequence(name)
    if sequence:
        return f"tum/{_short(sequence)}"
    return re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip(".") or "recording"
