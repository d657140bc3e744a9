"""Runs of several recordings: each recording has a run of its own inside, up to `optimize`; from there on they have one map.

``recordings/<name>/`` is an ordinary run directory, with the bytes that a run of that recording alone would have. The first four stages
of the run around them join what those made (`stages/joining.py`), so that a recording that is added later costs no other one anything.
"""

import os
import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

from slamcli.config.options import Config
from slamcli.datasets.joined import JoinedDataset, check_different, in_order, unique_names
from slamcli.datasets.protocol import Dataset
from slamcli.errors import SlamError
from slamcli.runs.pipeline import Begun, Pipeline
from slamcli.runs.places import RECORDINGS
from slamcli.runs.run_directory import RunDir, open_recording
from slamcli.slam.doubt import Finding
from slamcli.stages import NAMES, STAGES, Stage
from slamcli.stages.joining import JOINS, RecordingPart

LAST = list(JOINS)[-1]  # stage of a recording's own run
MOST = 1000  # recordings of a run


def pipeline(run: RunDir, config: Config, **more: Any) -> Pipeline:
    """Return what runs the stages of a run, be it of one recording or of several; the arguments are those of `Pipeline`."""
    return (PipelineOfSeveral if run.recordings else Pipeline)(run, config, **more)


class PipelineOfSeveral(Pipeline):
    """The stages of a run of several recordings under one configuration."""

    _forced: frozenset[str] = frozenset()  # stages to be run for every recording, up to date or not
    _looked_at: Mapping[str, Sequence[Finding]] = MappingProxyType({})

    def keep_looks(self, looked: Mapping[str, Sequence[Finding]]) -> None:
        """Take what looks at recordings found, by the folder of each, to be kept with the first stage of each one's own run."""
        self._looked_at = looked

    def bring_up_to_date(self, *, start: str | None = None, until: str | None = None, force: bool = False) -> None:
        """Run what is not up to date, in order; `start` (or, with `force`, the first) to `until` in any case."""
        first = NAMES.index(start) if start else 0 if force else len(NAMES)
        self._forced = frozenset(NAMES[first:])
        super().bring_up_to_date(start=start, until=until, force=force)

    def run_stage(self, stage: Stage, *, begun: Begun | None = None) -> None:
        """Run one stage: the first four for every recording that needs it, and then join what came of it."""
        super().run_stage(stage, begun=self._begin(stage) if stage.name in JOINS else begun)

    def _begin(self, stage: Stage) -> Begun:
        """Bring a stage of each recording's own run up to date."""
        dataset = self.dataset()
        assert isinstance(dataset, JoinedDataset)
        parts, costs = [], []
        for entry, recording in zip(self.run.recordings, dataset.parts, strict=True):
            own = RunDir.create(
                self.run.recording_path(entry["name"]), dataset=entry["dataset"], root=entry["root"], digest=recording.digest()
            )
            own.restore()
            with own.lock():
                own.write_config(self.config)
                costs += self._update(own, recording, stage, entry["name"])
            record = own.record(stage.name)
            assert record is not None, "it was brought up to date"
            parts.append(RecordingPart(entry["name"], own, record["summary"]))
        return Begun(
            partial(JOINS[stage.name], parts),
            seconds=sum(record["seconds"] for record in costs),
            cpu_seconds=sum(record["cpu_seconds"] for record in costs),
            peak_rss_mb=max((record["peak_rss_mb"] for record in costs), default=0.0),
        )

    def _update(self, own: RunDir, recording: Dataset, stage: Stage, name: str) -> list[dict[str, Any]]:
        """Bring a recording's own run up to date as far as a stage; returns the records of what was run."""
        inner = Pipeline(own, self.config, dataset=recording, progress=self._progress, tell=lambda line: self._tell(f"{name}: {line}"))
        inner.keep_looks({root: found for root, found in self._looked_at.items() if root == str(recording.root.resolve())})
        made = []
        for one in STAGES[: NAMES.index(stage.name) + 1]:
            is_forced = one is stage and stage.name in self._forced
            if is_forced or not inner.states(verify=True)[one.name].is_fresh:
                inner.run_stage(one)
                made.append(own.record(one.name) or {})
        return made


def entries(datasets: Sequence[Dataset], *, taken: Sequence[str] = ()) -> list[dict[str, str]]:
    """Describe recordings as ``run.json`` lists them, in the order in which they are joined."""
    check_different(datasets)
    if len(datasets) > MOST:
        raise SlamError(f"{len(datasets)} recordings: at most {MOST} make one map")
    ordered = [datasets[i] for i in in_order(datasets)]
    names = unique_names([dataset.name for dataset in ordered], taken)
    return [
        {"name": name, "dataset": dataset.name, "root": str(dataset.root.resolve()), "digest": dataset.digest()}
        for name, dataset in zip(names, ordered, strict=True)
    ]


def extend(run: RunDir, datasets: Sequence[Dataset]) -> None:
    """Make recordings part of a run, after those that are in it; one that is in it already stays where it is.

    A run of one recording becomes one of several. The run is locked by the caller.
    """
    there = run.recordings or [make_room(run)]
    known = {entry["root"] for entry in there}
    new = [dataset for dataset in datasets if str(dataset.root.resolve()) not in known]
    if not new:
        return
    for dataset in new:
        for entry in there:
            if entry["digest"] == dataset.digest():
                raise SlamError(f"{dataset.root}: the same recording as {entry['root']}, which is in {run.path} already")
    found = [*there, *entries(new, taken=[entry["name"] for entry in there])]
    config = run.config()
    opened = [*(open_recording(entry["root"], config, run.path) for entry in there), *new]
    dataset = joined(found, opened)
    run.extend(dataset=dataset.name, root=str(dataset.root), digest=dataset.digest(), recordings=found)


def joined(found: Sequence[dict[str, str]], datasets: Sequence[Dataset]) -> JoinedDataset:
    """Join opened recordings in the order of their entries."""
    of_root = {str(dataset.root.resolve()): dataset for dataset in datasets}
    return JoinedDataset([of_root[entry["root"]] for entry in found], [entry["name"] for entry in found])


def make_room(run: RunDir) -> dict[str, str]:
    """Make what a run of one recording has done the run of that recording inside it, and describe it as ``run.json`` lists it.

    Files are linked, so that the run stays what it is until its ``run.json`` lists recordings; done twice, nothing changes.
    """
    info = run.info()
    (name,) = unique_names([info["dataset"]])
    place = run.recording_path(name)
    part = run.path / RECORDINGS / f".{name}.part"
    shutil.rmtree(part, ignore_errors=True)
    if not place.exists():
        own = RunDir.create(part, dataset=info["dataset"], root=info["root"], digest=info["digest"])
        own.write_config(run.config())
        for stage in JOINS:
            if (run.path / stage).is_dir():
                shutil.copytree(run.path / stage, part / stage, copy_function=_link)
        part.rename(place)
    return {"name": name, "dataset": info["dataset"], "root": info["root"], "digest": info["digest"]}


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # another disk, or a file system without links
        shutil.copy2(source, target)
