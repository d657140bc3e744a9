"""Run directories as things on a disk: which there are, what may be cleared away, and one file to take along."""

import io
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slamcli import files
from slamcli.errors import Damaged, SlamError
from slamcli.hints import hint
from slamcli.runs.places import LATEST, RECORDINGS, RUNS
from slamcli.runs.run_directory import RunDir
from slamcli.stages import INTERMEDIATE, NAMES

DEEPEST = 3  # folders below runs/ in which runs are looked for: runs/tum/fr1_room is the deepest that slamcli makes by itself
NO_RESULTS = (*INTERMEDIATE, RECORDINGS)  # folders that hold none, with those of single recordings in a run of several
EARLIEST = (1980, 1, 1, 0, 0, 0)  # of a zip file: no clock in it, so that the same run gives the same bytes


@dataclass(frozen=True)
class Listed:
    """One run of a list."""

    path: str
    recording: str
    stages: list[str]  # that are finished
    frames: int | None
    located: int | None
    size: int  # bytes
    is_latest: bool
    damage: str = ""  # what is wrong with it and how it is repaired, where nothing else can be said of it

    def to_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def list_runs(folder: Path = RUNS) -> list[Listed]:
    """List the runs below a folder, by name; what is damaged is listed as that, and what is no run of this version is passed over."""
    latest = LATEST.resolve() if LATEST.exists() else None
    found = []
    for path in sorted(_run_folders(folder, DEEPEST)):
        try:
            run = RunDir.find(str(path))
            found.append(_listed(run, is_latest=path.resolve() == latest))
        except Damaged as error:
            if not any((path / stage / "stage.json").is_file() for stage in NAMES):  # another program's run.json
                continue
            size = sum(file.stat().st_size for file in files_of(RunDir(path)))
            found.append(Listed(str(path), "", [], None, None, size, path.resolve() == latest, damage=str(error)))
        except SlamError:
            continue
    return found


def _run_folders(folder: Path, depth: int) -> Iterator[Path]:
    for entry in folder.iterdir() if folder.is_dir() else ():
        if not entry.is_dir() or entry.is_symlink():
            continue
        if (entry / "run.json").is_file():
            yield entry
        elif depth > 1:
            yield from _run_folders(entry, depth - 1)


def _listed(run: RunDir, *, is_latest: bool) -> Listed:
    records = {stage: record for stage in NAMES if (record := run.record(stage)) is not None}
    frames = next((record["summary"]["frames"] for record in records.values() if "frames" in record["summary"]), None)
    loop = records["loop"]["summary"] if "loop" in records else {}
    return Listed(
        path=str(run.path),
        recording=run.info()["dataset"],
        stages=list(records),
        frames=frames,
        located=frames - loop["lost"] - loop.get("apart", 0) if frames is not None and "lost" in loop else None,
        size=sum(file.stat().st_size for file in files_of(run)),
        is_latest=is_latest,
    )


def files_of(run: RunDir) -> list[Path]:
    """List a run's files; what a running stage is writing is left out."""
    return sorted(
        path
        for path in run.path.rglob("*")
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(run.path).parts)
    )


def clean(run: RunDir) -> dict[str, int]:
    """Delete the stages that only later ones read, and return the bytes freed by stage; the run knows from then on that it was cleaned.

    Raises SlamError where loop has not been run: nothing would be left of the run.
    """
    if run.record("loop") is None:
        raise SlamError(f"{run.path}: loop has not been run, so there are no results to keep; finish it with: {hint().update(run.path)}")
    freed = {}
    with run.lock():
        for stage in NO_RESULTS:
            folder = run.path / stage
            if folder.is_dir():
                freed[stage] = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
                gone = run.path / f".{stage}.old"
                folder.rename(gone)  # at once: a stage is complete or absent, whatever happens
                run.mark_cleaned(stage)
                shutil.rmtree(gone)
    return freed


def archive(run: RunDir, out: Path, *, skip: Sequence[str] = (), overwrite: bool = False) -> int:
    """Write a run's files to the zip file `out`, all or none; returns how many they are. The same run gives the same bytes.

    skip : stages that are left out; what is unpacked knows that they were, as after `clean`
    overwrite : take the place of an archive even where that holds stages which this one would lack
    Raises Damaged where a file is not what its stage recorded: what is kept for long is worth a look. SlamError where more would be lost.
    """
    if out.resolve().is_relative_to(run.path.resolve()):
        raise SlamError(f"{out}: lies in the run that is to be packed; choose another place")
    _check_intact(run, skip)
    chosen = [path for path in files_of(run) if path.relative_to(run.path).parts[0] not in skip]
    lost = stages_in(out) - {path.relative_to(run.path).parts[0] for path in chosen}
    if lost and not overwrite:
        there = ", ".join(name for name in NAMES if name in lost)
        raise SlamError(
            f"{out}: holds {there}, which the new archive would lack; choose another name, or say {hint().argument('overwrite')}"
        )
    with files.whole(out) as file, zipfile.ZipFile(file, "w", compression=zipfile.ZIP_DEFLATED) as packed:
        for path in chosen:
            entry = zipfile.ZipInfo(f"{run.path.resolve().name}/{path.relative_to(run.path).as_posix()}", date_time=EARLIEST)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            is_about = path == run.path / "run.json"
            text = files.sealed(run.without([name for name in skip if (run.path / name).is_dir()])) if is_about else ""
            with io.BytesIO(text.encode()) if is_about else path.open("rb") as source, packed.open(entry, "w", force_zip64=True) as target:
                shutil.copyfileobj(source, target, 1 << 20)
    return len(chosen)


def stages_in(archive: Path) -> set[str]:
    """List the stages that an archive holds; none where there is no archive."""
    try:
        with zipfile.ZipFile(archive) as packed:
            inside = {parts[1] for name in packed.namelist() if len(parts := name.split("/")) > 2}
    except (OSError, zipfile.BadZipFile, NotImplementedError, ValueError):  # the last of names that are no text
        return set()
    return inside & set(NAMES)


def _check_intact(run: RunDir, skip: Sequence[str]) -> None:
    run.config()
    if damaged := run.damaged_figures():
        raise Damaged(f"{run.path / damaged[0]}: it is damaged; remove it with: {hint().repair(run.path)}")
    for stage in NAMES:
        if stage not in skip and (found := run.damage(stage, verify=True)):
            raise Damaged(f"{run.path}/{found}: it is damaged; repair it with: {hint().repair(run.path)}")
    for entry in run.recordings if RECORDINGS not in skip else ():
        own = RunDir(run.recording_path(entry["name"]))
        if own.path.is_dir():
            try:
                own.info()
                _check_intact(own, skip)
            except SlamError as error:
                raise SlamError(f"{str(error).partition('; ')[0]}; repair it with: {hint().repair(run.path)}") from error
