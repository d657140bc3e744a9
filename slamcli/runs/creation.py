"""Make the run of a recording, or of several that are to have one map, and hold it while something is made in it."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from slamcli import __version__
from slamcli.config.options import Config
from slamcli.console import Progress, log_file, silent
from slamcli.errors import SlamError
from slamcli.hints import hint
from slamcli.runs.places import default_path
from slamcli.runs.run_directory import RunDir
from slamcli.runs.several import entries, joined

if TYPE_CHECKING:
    from slamcli.datasets import Dataset


def create_run(
    targets: Sequence[str],
    *,
    resolve: Callable[[Config | None], Config],
    path: str | os.PathLike[str] | None = None,
    data: str | None = None,
    progress: Progress = silent,
    opened: "Callable[[str, Config], Dataset | None]" = lambda target, config: None,
) -> "tuple[RunDir, Dataset, Config]":
    """Open the recording, or several that are to have one map, and make their run, or open the run that is there.

    resolve : gives the configuration under which to run, from the run's own; None where there is no run yet
    opened : gives a recording that the caller has opened already under a configuration, or None

    No stage is run and no configuration written. Raises SlamError where several are given, but no `path`.
    """
    if not targets:
        raise SlamError("no recording named; give a folder, tum/fr1_room or demo")
    if len(targets) > 1 and path is None:
        raise SlamError(
            f"several recordings make one map, whose run needs a name, such as {hint().argument('path')} runs/house; "
            f"for a run of each: {hint().each_alone()}"
        )

    def open_all(config: Config) -> "list[Dataset]":
        return [opened(target, config) or open_target(target, config, data, progress) for target in targets]

    if path is not None:
        RunDir(Path(path)).restore()
    first = resolve(RunDir(Path(path)).config() if path is not None else None)
    datasets = open_all(first)
    place = Path(path) if path is not None else default_path(datasets[0].name)
    RunDir(place).restore()
    config = resolve(RunDir(place).config())
    if (config.camera, config.recording) != (first.camera, first.recording):  # an earlier command gave this run others
        datasets = open_all(config)
    if len(datasets) > 1:
        return *_create_of_several(place, datasets), config
    (dataset,) = datasets
    directory = RunDir.create(place, dataset=dataset.name, root=str(dataset.root.resolve()), digest=dataset.digest())
    return directory, dataset, config


def open_target(target: str, config: Config, data: str | None, progress: Progress) -> "Dataset":
    """Open a recording by folder or name, as `config` says; `data` is a folder to look in first."""
    from slamcli.datasets import open_dataset

    return open_dataset(target, data=data, camera=dict(config.camera) or None, options=config.recording, progress=progress)


def _create_of_several(place: Path, datasets: "Sequence[Dataset]") -> "tuple[RunDir, Dataset]":
    """Make the run of several recordings; in a run of the same that is there they keep their order and their names."""
    found = entries(datasets)
    roots = {entry["root"]: entry for entry in found}
    there = RunDir(place).recordings if (place / "run.json").is_file() else []
    if {entry["root"] for entry in there} == roots.keys():
        found = [{**entry, "digest": roots[entry["root"]]["digest"]} for entry in there]
    dataset = joined(found, datasets)
    return RunDir.create(place, dataset=dataset.name, root=str(dataset.root), digest=dataset.digest(), recordings=found), dataset


@contextmanager
def writing(directory: RunDir, config: Config, *, wait: bool = False) -> Iterator[None]:
    """Lock the run, log to its file, and make `config` its configuration; `wait` for another process that holds it."""
    info = directory.info()
    what = f"slamcli {__version__} makes {info['dataset']} of {info['root']}"
    with directory.lock(wait=wait), log_file(directory.path / "log.txt", what):
        directory.write_config(config)
        yield
