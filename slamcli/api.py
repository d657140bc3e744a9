"""The program from Python: make a run, open one, read what it made.

>>> import slamcli
>>> run = slamcli.run("demo", settings={"track.min_inliers": 20}, until="loop")
>>> run.trajectory("track").T_wc  # (N, 4, 4), camera to world

Nothing is printed: progress goes to the `progress` of the caller, single lines to `tell`, warnings to the logger "slamcli".
"""

import copy
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.config.toml import Settings
from slamcli.console import Progress, Tell, silent
from slamcli.errors import SlamError
from slamcli.hints import hint
from slamcli.runs import places
from slamcli.runs.creation import create_run, open_target, writing
from slamcli.runs.run_directory import RunDir
from slamcli.runs.several import extend, pipeline
from slamcli.runs.staleness import State
from slamcli.stages import NAMES

if TYPE_CHECKING:
    from slamcli.datasets import Dataset
    from slamcli.evaluation.map_verdict import Verdict
    from slamcli.evaluation.trajectory_error import Ape, Rpe
    from slamcli.formats.cloud import Points
    from slamcli.geometry.camera import Camera
    from slamcli.geometry.octree import Octree
    from slamcli.inspection.depth_camera import DepthCamera
    from slamcli.navigation.floor_plan import FloorPlan
    from slamcli.schema import Grid, Ground, Trajectory
    from slamcli.slam.doubt import Finding

    Look = Callable[[Dataset], Sequence[Finding] | None]

__all__ = ["Run", "open_run", "run"]

log = logging.getLogger(__name__)

TRIAL_FRAMES = 300  # at the recording's beginning, of which a map is made to ask it about the depth camera that edges told
LEAST_TRIAL = 1e-3  # [s]; an end of 0 is none


def run(
    target: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    settings: Settings = (),
    config: str | None = None,
    path: str | os.PathLike[str] | None = None,
    data: str | None = None,
    start: str | None = None,
    until: str | None = None,
    force: bool = False,
    progress: Progress = silent,
    tell: Tell = log.info,
    look: "Look | None" = None,
) -> "Run":
    """Make a run of a recording, or bring the one that is there up to date: exactly the stages that need it.

    target : a recording's folder, a name such as ``tum/fr1_room``, or ``demo``; of several, which then have one map, `path` must be given
    settings : options by full name, ``{"track.min_inliers": 20}``, laid over the run's own (the defaults for a new run)
    config : fast, accurate, default or a TOML file, to start from instead of the run's own
    path : the run directory, or a name for it under ``runs/``; None: ``runs/<recording>``
    data : folder of recordings to look in first
    start, until, force : run from this stage on whether up to date or not; stop after this one; run every stage
    progress : passes items through under a bar, as ``progress(items, label, total=None)``; tell : takes single lines
    look : is given each recording before its first stage runs. It returns findings that the run keeps, or None; an error it raises
        ends the call before anything is computed

    Raises SlamError for whatever the caller can mend, such as a recording that is not there or an option that is not known.
    """
    settings = settings if isinstance(settings, Mapping) else tuple(settings)
    resolve = partial(toml.resolve, name_or_file=config, settings=settings)
    place = None if path is None else places.named(os.fspath(path))
    targets = [str(target)] if isinstance(target, (str, os.PathLike)) else [str(one) for one in target]
    reopen = partial(create_run, targets, path=place, data=data, progress=progress)
    opened, dataset, resolved = reopen(resolve=resolve)
    found: dict[str, Sequence[Finding]] = {}
    if look is not None and (force or start == NAMES[0] or not pipeline(opened, resolved, dataset=dataset).states()[NAMES[0]].is_fresh):
        found = {str(one.root.resolve()): look(one) or () for one in getattr(dataset, "parts", [dataset])}
        said = [finding.name for findings in found.values() for finding in findings]
        if resolved.recording.find_depth_camera and len(targets) == 1 and "registration" in said:
            ((root, findings),) = found.items()
            tell("depth does not lie on colour: looking for its camera takes some 20 s")
            opened, dataset, resolved, found[root] = _registered(opened, dataset, resolved, findings, reopen)
    which: dict[str, Any] = {"start": start, "until": until, "force": force}
    _bring_up_to_date(opened, resolved, dataset, looked=found, progress=progress, tell=tell, **which)
    return Run(opened)


def open_run(path: str | os.PathLike[str] | None = None, *, restore: bool = False) -> "Run":
    """Open the run directory `path`, or the run of that name under ``runs/``; None: the one that $SLAMCLI_RUN names, else the last one made here.

    restore : where ``run.json`` or ``config.toml`` is damaged, write it anew from what the stages recorded

    Raises SlamError where there is none, or a damaged one.
    """
    return Run(RunDir.find(None if path is None else str(path), restore=restore))


class Run:
    """A run: what each stage made, and what of it still holds. Reading never changes it; `update` and `run_stage` do."""

    def __init__(self, directory: RunDir) -> None:
        self.directory = directory

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @property
    def path(self) -> Path:
        """The run directory."""
        return self.directory.path

    @property
    def name(self) -> str:
        """The recording's name."""
        return str(self.directory.info()["dataset"])

    def config(self) -> Config:
        """Read the run's configuration."""
        return self.directory.config()

    def dataset(self) -> "Dataset":
        """Open the recording; SlamError when it is not there any more."""
        return self.directory.dataset()

    # making

    def update(
        self,
        *,
        settings: Settings = (),
        config: str | None = None,
        start: str | None = None,
        until: str | None = None,
        force: bool = False,
        progress: Progress = silent,
        tell: Tell = log.info,
    ) -> "Run":
        """Change settings, if any are given, and run exactly the stages that need it; the arguments are those of `slamcli.run`."""
        self.directory.restore()
        resolved = toml.resolve(self.config(), config, settings)
        dataset = self._read_otherwise(resolved)
        _bring_up_to_date(self.directory, resolved, dataset, start=start, until=until, force=force, progress=progress, tell=tell)
        return self

    def _read_otherwise(self, config: Config) -> "Dataset | None":
        """Open the recording where `config` has it read otherwise than before: where it cannot be, nothing is changed. None where it has not."""
        before = self.config()
        if (config.recording, config.camera) == (before.recording, before.camera):
            return None
        dataset = self.directory.dataset(config)
        return None if self.directory.recordings else dataset

    def add(
        self,
        *targets: str | os.PathLike[str],
        data: str | None = None,
        progress: Progress = silent,
        tell: Tell = log.info,
        look: "Look | None" = None,
    ) -> "Run":
        """Add recordings to the map, and bring the run up to date; none that is in it already is tracked again.

        The arguments are those of `slamcli.run`. Done again, as after an interruption, it goes on.
        """
        self.directory.restore()
        config = self.config()
        datasets = [open_target(str(target), config, data, progress) for target in targets]
        looked = {str(dataset.root.resolve()): look(dataset) or () for dataset in datasets} if look is not None else {}
        with writing(self.directory, config):
            self.directory.mark_latest()
            extend(self.directory, datasets)
            stages = pipeline(self.directory, config, progress=progress, tell=tell)
            stages.keep_looks(looked)
            stages.bring_up_to_date()
        return self

    def run_stage(
        self, stage: str, *, settings: Settings = (), config: str | None = None, progress: Progress = silent, tell: Tell = log.info
    ) -> "Run":
        """Run one stage alone, even when it is up to date, from whatever its predecessors left."""
        resolved = toml.resolve(self.config(), config, settings)
        with writing(self.directory, resolved):
            pipeline(self.directory, resolved, progress=progress, tell=tell).run_alone(stage)
        return self

    # what holds

    def status(self, *, settings: Settings = (), config: str | None = None, verify: bool = False) -> dict[str, State]:
        """Judge every stage: up to date, stale and why, missing or damaged.

        settings, config : judge as if these had been given; nothing is changed
        verify : read every file again and compare its digest
        """
        return pipeline(self.directory, toml.resolve(self.config(), config, settings)).states(verify=verify)

    def record(self, stage: str) -> dict[str, Any] | None:
        """Read what a stage said of itself: configuration, inputs, outputs, cost, warnings; None before it was run."""
        return copy.deepcopy(self.directory.record(stage))

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return the figures that each finished stage counted, by stage."""
        return {name: record["summary"] for name in NAMES if (record := self.record(name)) is not None}

    # what was made

    def camera(self, stage: str = "loop") -> "Camera":
        """Read the intrinsics that extract used, or those known after optimize or loop."""
        return self.directory.camera(stage)

    def trajectory(self, stage: str | None = None, *, frame: Literal["world", "level"] = "world") -> "Trajectory":
        """Read the poses of all frames that have one after track, optimize or loop; None: the last of these there is.

        frame : world, or level: z up, floor at z = 0
        """
        from slamcli.evaluation import run_trajectories
        from slamcli.schema import Trajectory

        found = run_trajectories.stage_trajectory(self.directory, stage or run_trajectories.last_stage(self.directory))
        return Trajectory(stamp=found.stamp, T_wc=self.ground().T_lw @ found.T_wc) if frame == "level" else found

    def cloud(self) -> "Points":
        """Read the dense cloud in the level frame: xyz (N, 3) [m], rgb (N, 3) uint8, normal (N, 3)."""
        from slamcli.formats import cloud

        return cloud.read_ply(self.directory.stage_path("densify", "cloud.ply"))

    def ground(self) -> "Ground":
        """Read the floor and the level frame."""
        from slamcli.schema import Ground

        return self.directory.load(Ground, "densify")

    def octree(self) -> "Octree":
        """Read the octree of occupied and free space in the level frame."""
        from slamcli.formats import octomap

        return octomap.read(self.directory.stage_path("octree", "map.ot"))

    def grid(self) -> "Grid":
        """Read the navigation grid in the level frame."""
        from slamcli.schema import Grid

        return self.directory.load(Grid, "grid2d")

    def floor_plan(self, *, wall_height: float = 1.2, door_width: float = 1.2) -> "FloorPlan":
        """Draw the floor plan: walls that reach up to `wall_height` [m], rooms, and doors up to `door_width` [m] between them."""
        from slamcli.navigation.floor_plan import make_floor_plan
        from slamcli.navigation.rooms import LEAST_AREA

        xyz, _, normal = self.cloud()
        if normal is None:
            raise SlamError(f"{self.path}: the cloud has no normals, which walls are found by")
        return make_floor_plan(self.grid(), xyz, normal, wall_height=wall_height, door_width=door_width, least_area=LEAST_AREA)

    def ape(self, stage: str | None = None, *, truth: "Trajectory | None" = None) -> "Ape":
        """Measure the absolute pose error after a stage (None: the last there is); SlamError without ground truth.

        truth : poses to compare with instead of the recording's true ones, such as another run's trajectory
        """
        from slamcli.evaluation import run_trajectories, trajectory_error

        stage = stage or run_trajectories.last_stage(self.directory)
        truth = run_trajectories.ground_truth(self.directory) if truth is None else truth
        return trajectory_error.ape(
            self.trajectory(stage), truth, n_frames=run_trajectories.frame_count(self.directory), name=self.name, stage=stage
        )

    def rpe(self, stage: str | None = None, *, seconds: float | None = 1.0, truth: "Trajectory | None" = None) -> "Rpe":
        """Measure the relative pose error over an interval, or from one frame to the next where that is None; `truth` as for `ape`."""
        from slamcli.evaluation import run_trajectories, trajectory_error
        from slamcli.schema import FrameTimes

        stage = stage or run_trajectories.last_stage(self.directory)
        truth = run_trajectories.ground_truth(self.directory) if truth is None else truth
        stamp = self.directory.load(FrameTimes, stage).stamp
        return trajectory_error.rpe(self.trajectory(stage), truth, frame_stamp=stamp, name=self.name, stage=stage, seconds=seconds)

    def verdict(self) -> "Verdict | None":
        """Judge whether a robot could use the map, and why not; None while there is no grid."""
        from slamcli.evaluation import map_verdict

        return map_verdict.of_run(self.directory)

    def report(self, path: str | os.PathLike[str] | None = None) -> Path:
        """Write one self-contained HTML page about the run, to ``report.html`` in its directory unless `path` is given."""
        from slamcli import report

        target = Path(path) if path is not None else self.directory.own_file("report.html")
        report.make(self.directory, target)
        return target


def _registered(
    opened: RunDir, dataset: "Dataset", config: Config, found: "Sequence[Finding]", reopen: "Callable[..., tuple[RunDir, Dataset, Config]]"
) -> "tuple[RunDir, Dataset, Config, Sequence[Finding]]":
    """Register depth that a look found not to lie on colour, where its camera shows beyond doubt, and say so; else all is as it was."""
    from slamcli.inspection import depth_camera
    from slamcli.slam.doubt import Finding

    camera = depth_camera.find(dataset) if dataset.depth_camera is None else None
    if camera is None or not camera.is_sure:
        return opened, dataset, config, found
    camera = _told_by_map(camera, dataset, config)
    registered = replace(config, recording=replace(config.recording, depth_camera=camera.option))
    opened, dataset, _ = reopen(resolve=lambda config: registered)
    told = f"{camera.told}; {hint().setting('recording.find_depth_camera', False)} leaves depth as it is"
    log.warning("%s: %s", dataset.root, told)
    others = [finding for finding in found if finding.name != "registration"]
    return opened, dataset, registered, [*others, Finding("depth_camera", told)]


def _told_by_map(camera: "DepthCamera", dataset: "Dataset", config: Config) -> "DepthCamera":
    """Make a map of the recording's beginning with the depth camera that edges told, and return the camera as the map knows it."""
    from slamcli.runs import trial

    seconds = float(dataset.stamp[min(len(dataset), TRIAL_FRAMES) - 1] - dataset.stamp[0])
    beginning = replace(config.recording, depth_camera=camera.option, end=config.recording.start + max(seconds, LEAST_TRIAL))
    config = replace(config, recording=beginning)
    evidence = trial.registration_evidence(
        open_target(str(dataset.root), config, None, silent), config, camera.registration(dataset.camera)
    )
    better = camera.told_by(evidence) if evidence is not None else camera
    return better if better.is_sure else camera


def _bring_up_to_date(
    directory: RunDir,
    config: Config,
    dataset: "Dataset | None",
    *,
    progress: Progress,
    tell: Tell,
    looked: "Mapping[str, Sequence[Finding]]" = MappingProxyType({}),
    **which: Any,
) -> None:
    with writing(directory, config):
        directory.mark_latest()
        stages = pipeline(directory, config, dataset=dataset, progress=progress, tell=tell)
        stages.keep_looks(looked)
        stages.bring_up_to_date(**which)
