"""Recordings: find one by name, recognise its format, open it.

A reader is a module with ``recognises(folder) -> bool`` and ``read(folder, *, name, camera) -> Dataset``; a new format is one file and one
line in READERS.
"""

import os
import re
from pathlib import Path
from typing import Any

from slamcli.console import Progress, silent
from slamcli.datasets import tum
from slamcli.datasets.recording import Dataset
from slamcli.errors import SlamError
from slamcli.user_cache import user_cache

__all__ = ["READERS", "Dataset", "open_dataset", "silent"]

READERS = {"tum": tum}
DEMO = "demo"

# Names of the literature for recordings whose folders are called otherwise.
ALIASES = {
    "fr3_office": "rgbd_dataset_freiburg3_long_office_household",
    "fr3_nst": "rgbd_dataset_freiburg3_nostructure_texture_near_withloop",
}


def open_dataset(target: str, *, data: str | None = None, camera: dict[str, Any] | None = None, progress: Progress = silent) -> Dataset:
    """Open a recording.

    target : a folder, ``tum/fr1_room`` (or ``tum/rgbd_dataset_freiburg1_room``), or ``demo``
    data : folder to look in first; then $SLAMCLI_DATA, ./data and the user's cache
    camera : intrinsics that replace those found

    A recording of the TUM set that is nowhere is downloaded into the cache, the demo is rendered into it, both once.
    """
    folder, name = _locate(str(target), data, progress)
    for reader in READERS.values():
        if reader.recognises(folder):
            return reader.read(folder, name=name, camera=camera)
    raise SlamError(f"{folder}: not a recording; a folder with rgb.txt and depth.txt (TUM layout) is expected")


def _locate(target: str, data: str | None, progress: Progress) -> tuple[Path, str]:
    """Give (folder, name), downloading or rendering what is not there."""
    if target == DEMO:
        from slamcli.datasets.demo import demo_folder

        return demo_folder(user_cache(), progress=progress), DEMO
    if not target.strip():
        raise SlamError("no recording named; give a folder, tum/fr1_room or demo")
    path = Path(target).expanduser()
    if path.is_dir():
        return path, _name_of(path)
    if path.exists():
        raise SlamError(f"{path}: a file; give the folder of a recording (unpack archives first)")
    roots = _data_roots(data)
    candidates = [root / variant for root in roots for variant in _variants(target)]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate, _name_of(candidate)
    sequence = _tum_sequence(target)
    if sequence is None:
        looked = ", ".join(str(root) for root in roots)
        raise SlamError(f"{target}: no such recording; looked for this folder itself and under {looked}")
    from slamcli.datasets.download import download_tum

    folder = download_tum(sequence, user_cache() / "datasets" / "tum", progress=progress)
    return folder, _name_of(folder)


def _data_roots(data: str | None) -> list[Path]:
    if data is not None and not Path(data).expanduser().is_dir():
        raise SlamError(f"--data {data}: no such folder")
    given = [data, os.environ.get("SLAMCLI_DATA"), "data"]
    return [Path(root).expanduser() for root in given if root] + [user_cache() / "datasets"]


def _variants(target: str) -> list[str]:
    """Give the folders below a data root that a name can mean; the root may be the folder `tum` itself."""
    sequence = _tum_sequence(target)
    names = [target] if not Path(target).is_absolute() else []
    for form in [sequence, _short(sequence)] if sequence else []:
        names += [f"tum/{form}", form]
    return names


def _tum_sequence(target: str) -> str | None:
    """Give the full name of a TUM sequence from any of its forms, None for what is none."""
    short = target.removeprefix("tum/")
    if short in ALIASES:
        return ALIASES[short]
    found = re.fullmatch(r"(?:rgbd_dataset_)?(?:freiburg|fr)([123])_([A-Za-z0-9_]+)", short)
    return f"rgbd_dataset_freiburg{found.group(1)}_{found.group(2)}" if found else None


def _short(sequence: str) -> str:
    short_of = {full: alias for alias, full in ALIASES.items()}
    return short_of.get(sequence, sequence.replace("rgbd_dataset_freiburg", "fr"))


def _name_of(folder: Path) -> str:
    """Give the name of a recording, fit for a folder below runs/."""
    name = folder.resolve().name
    sequence = _tum_sequence(name)
    if sequence:
        return f"tum/{_short(sequence)}"
    return re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip(".") or "recording"
