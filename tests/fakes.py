"""Stand-ins for the recording and the eight stages: the pipeline is tested without any image, in milliseconds a stage."""

import hashlib
import json
import os
import signal
import sys
from pathlib import Path
from types import ModuleType

from slamcli import console
from slamcli.config.options import Config
from slamcli.runs.pipeline import Pipeline
from slamcli.runs.run_directory import RunDir
from slamcli.stages import STAGES, Stage

IGNORED = {"extract": ("cell",)}  # options that change no byte of the fake's output, for the early cut-off


class FakeDataset:
    """A recording known by its digest alone."""

    name = reader = "fake"
    warnings = ("rgb.txt: 2 repeated stamps",)

    def __init__(self, root: Path, content: str = "frames") -> None:
        self.root, self.content = root, content

    def digest(self) -> str:
        return "sha256:" + hashlib.sha256(self.content.encode()).hexdigest()


def stage_text(stage: Stage, inputs, cfg, tools) -> str:
    """Make an output that depends on everything a stage may depend on."""
    read = {need: inputs.path(need, "out.txt").read_text() for need in stage.needs if need != "dataset"}
    if "dataset" in stage.needs:
        read["dataset"] = inputs.dataset.digest()
    options = {name: str(getattr(cfg, name)) for name in stage.config}
    if stage.name in IGNORED:
        section = getattr(cfg, stage.name)
        options[stage.name] = str({k: v for k, v in vars(section).items() if k not in IGNORED[stage.name]})
    text = json.dumps([read, options, int(tools.rng().integers(1 << 30))])
    return hashlib.sha256(text.encode()).hexdigest()


COUNTS = {  # what the outcome of a run tells of
    "loop": {"lost": 1, "closures": 2},
    "densify": {"points": 500},
    "octree": {"occupied_cells": 60, "free_cells": 70},
    "grid2d": {"columns": 8, "rows": 9, "occupied": 10, "free": 11},
}


def module(stage: Stage, on_run=lambda out: None) -> ModuleType:
    """Build ``slamcli.stages.<name>``; `on_run` gets the output folder when half of the output is written."""

    def run(inputs, out, cfg, tools):
        text = stage_text(stage, inputs, cfg, tools)
        (out / "out.txt").write_text(text[:10])
        on_run(out)
        (out / "out.txt").write_text(text)
        return {"frames": 3, **COUNTS.get(stage.name, {})}

    made = ModuleType(f"slamcli.stages.{stage.name}")
    made.run = run
    return made


def install(modules: dict) -> None:
    """Put fakes of all stages in place of the real ones; `modules` is ``sys.modules`` or a monkeypatched view of it."""
    for stage in STAGES:
        modules[f"slamcli.stages.{stage.name}"] = module(stage)


def make_run(path: Path, root: Path, config: Config | None = None) -> Pipeline:
    """Make or open a run of a fake recording."""
    dataset = FakeDataset(root)
    run = RunDir.create(path, dataset="fake", root=str(root), digest=dataset.digest())
    run.write_config(config or run.config())
    return Pipeline(run, run.config(), dataset=dataset, tell=console.say)


def digests(run: RunDir) -> dict[str, str]:
    """Return each finished stage's output digest."""
    return {stage.name: record["digest"] for stage in STAGES if (record := run.record(stage.name))}


def die(*_: object) -> None:
    """End this process as a power cut would: nothing is cleaned up."""
    os.kill(os.getpid(), signal.SIGKILL)


def run_and_die(path: str, root: str, stage: str, where: str) -> None:
    """Bring a run up to date in a process of its own that is killed in `stage`: within it, or between commit's two renames."""
    install(sys.modules)
    if where == "inside":
        sys.modules[f"slamcli.stages.{stage}"] = module(next(s for s in STAGES if s.name == stage), die)
    else:
        rename = Path.rename

        def rename_once(self: Path, target: Path) -> Path:
            moved = rename(self, target)
            if Path(target).name == f".{stage}.old":
                die()
            return moved

        Path.rename = rename_once
    pipeline = make_run(Path(path), Path(root))
    with pipeline.run.lock():
        pipeline.bring_up_to_date(force=where != "inside")
