"""Run stages: give each what it declared and nothing else, record what it did, and run exactly those that are not up to date."""

import functools
import importlib
import logging
import math
import platform
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

from slamcli import __version__, address_space, files, interruption
from slamcli.config.options import Config
from slamcli.console import Progress, Tell, at_work, silent, stage_line
from slamcli.errors import SlamError
from slamcli.hints import hint
from slamcli.jit import compilation
from slamcli.parallel import one_thread_in_blas
from slamcli.runs import damage, source_code, staleness
from slamcli.runs.cost_meter import Meter, return_free_memory
from slamcli.runs.run_directory import RunDir
from slamcli.runs.staleness import State
from slamcli.schema import FORMAT
from slamcli.slam import doubt
from slamcli.slam.doubt import Finding
from slamcli.stages import NAMES, STAGES, Stage, stage_named

if TYPE_CHECKING:
    import numpy as np

    from slamcli.datasets import Dataset
    from slamcli.geometry.camera import Camera

__all__ = ["NAMES", "STAGES", "Inputs", "Pipeline", "Settings", "Stage", "Tools"]

Record = TypeVar("Record")
log = logging.getLogger(__name__)

FEATURES = "extract"  # the stage whose rows those of others number
MOST_WARNINGS = 100  # kept in a record and shown; the rest are counted
PACKAGES = {"numpy": "numpy", "numba": "numba", "opencv": "opencv-python-headless", "open3d": "open3d", "scipy": "scipy", "g2o": "g2opy"}


class Settings:
    """The configuration as one stage may see it: its declared sections and the seed. Anything else would escape the staleness key."""

    def __init__(self, stage: Stage, config: Config) -> None:
        self.seed = config.seed
        for name in stage.config:
            setattr(self, name, getattr(config, name))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"the stage does not declare the section {name!r} in its row of STAGES")


class Inputs:
    """What a stage may read: the stages it declares, and the recording."""

    def __init__(self, stage: Stage, run: RunDir, dataset: Callable[[], "Dataset"]) -> None:
        self._stage, self._run, self._dataset = stage, run, dataset
        self._lengths: dict[str, dict[str, int]] = {}  # by stage, of its arrays and those of the features with them

    def _declared(self, name: str) -> str:
        if name not in self._stage.needs:
            raise AttributeError(f"{self._stage.name} does not declare that it needs {name}")
        return name

    @property
    def dataset(self) -> "Dataset":
        """Return the recording."""
        self._declared("dataset")
        return self._dataset()

    def load(self, cls: type[Record], stage: str) -> Record:
        """Read a record of arrays that `stage` wrote; nothing may be written to them."""
        from slamcli import artifacts

        folder = self._run.intact(self._declared(stage), *artifacts.file_names(cls))
        if stage not in self._lengths:
            features = artifacts.lengths(self._run.path / FEATURES) if FEATURES in self._stage.needs else {}
            self._lengths[stage] = artifacts.lengths(folder, features)
        return artifacts.adopted(artifacts.load(cls, folder, self._lengths[stage]))

    def camera(self, stage: str = "extract") -> "Camera":
        """Return the intrinsics that extract used, or those known after optimize or loop."""
        return self._run.camera(self._declared(stage))

    def path(self, stage: str, *names: str) -> Path:
        """Name a file that `stage` wrote, unchanged since; SlamError otherwise."""
        return self._run.intact(self._declared(stage), *(["/".join(names)] if names else [])).joinpath(*names)


class Tools:
    """What a stage may use beside its inputs: threads, progress, warnings, random numbers.

    progress : passes items through under a bar, as ``progress(items, label, total=None)``
    """

    def __init__(self, stage: str, config: Config, progress: Progress = silent) -> None:
        self.progress = progress
        self.workers = config.run.workers
        self.warnings: list[str] = []
        self.n_warnings = 0
        self._stage, self._seed = stage, config.seed

    def warn(self, message: str) -> None:
        """Tell the user of something that was worked round; the record keeps it."""
        self.n_warnings += 1
        if self.n_warnings <= MOST_WARNINGS:
            self.warnings.append(message)
            log.warning("%s: %s", self._stage, message)
        else:
            log.debug("%s: %s", self._stage, message)

    def rng(self) -> "np.random.Generator":
        """Return the stage's own random numbers: the same for the same seed, whatever ran before."""
        import numpy as np

        return np.random.default_rng([self._seed, zlib.crc32(self._stage.encode())])


@dataclass(frozen=True)
class Begun:
    """A stage of which a part was done elsewhere: how it goes on from there, and what that part has cost."""

    go_on: Callable[..., Mapping[str, Any]]  # in place of the stage's own `run`
    seconds: float
    cpu_seconds: float
    peak_rss_mb: float


class Pipeline:
    """The stages of one run under one configuration."""

    def __init__(
        self, run: RunDir, config: Config, *, dataset: "Dataset | None" = None, progress: Progress = silent, tell: Tell = log.info
    ) -> None:
        self.run, self.config = run, config
        self._progress, self._tell = progress, tell
        self.recording_note = ""  # why the recording could not be looked at, where it could not
        self.looked: Sequence[Finding] = ()  # what a look at the recording found, to be kept with the first stage
        self._opened = dataset
        self._dataset_digest: str | None = None

    def keep_looks(self, looked: "Mapping[str, Sequence[Finding]]") -> None:
        """Take what looks at recordings found, by the folder of each, to be kept with the first stage."""
        self.looked = [finding for found in looked.values() for finding in found]

    # what holds

    def dataset(self) -> "Dataset":
        """Open the recording once."""
        if self._opened is None:
            self._opened = self.run.dataset(self.config)
        return self._opened

    def states(
        self, *, verify: bool = False, until: str | None = None, known: Mapping[str, State] = MappingProxyType({})
    ) -> dict[str, State]:
        """Judge every stage, or those that `until` rests on, looking at the recording and at the files that options name as they are now.

        known : states judged already, which are believed
        """
        return self.run.states(self.config, verify=verify, until=until, input_digest=self._input_digest, known=known)

    def _input_digest(self, name: str) -> str | None:
        """Digest the recording or a file an option names; None where it is not there, so that what was made from it still stands."""
        if name != "dataset":
            section, _, option = name.partition(".")
            path = Path(getattr(getattr(self.config, section), option))
            return f"sha256:{files.sha256(path)}" if path.is_file() else None
        try:
            self._dataset_digest = self._dataset_digest or self.dataset().digest()
        except SlamError as error:
            self.recording_note = f"{error}; what was made from the recording is believed to be of it"
        return self._dataset_digest

    def notes(self, states: Mapping[str, State]) -> list[str]:
        """Say what is worth knowing beside the states: a recording that is gone, results made with other versions."""
        found = [self.recording_note] if self.recording_note else []
        found += [f"{name} is damaged; remove it with: {hint().repair(self.run.path)}" for name in self.run.damaged_figures()]
        here = environment()
        for name, value in here.items():
            stages: dict[str, list[str]] = {}
            for state in states.values():
                then = state.record.get("environment", {}).get(name, value)
                if then != value and name != "slamcli":
                    stages.setdefault(then, []).append(state.stage)
            found += [f"{', '.join(made)} made with {name} {then}, here is {value}: digits may differ" for then, made in stages.items()]
        return found

    # making it hold

    def bring_up_to_date(self, *, start: str | None = None, until: str | None = None, force: bool = False) -> None:
        """Run what is not up to date, in order; `start` (or, with `force`, the first) to `until` in any case."""
        last = NAMES.index(until) if until else len(NAMES) - 1
        first_forced = NAMES.index(start) if start else 0 if force else len(NAMES)
        if start and last < first_forced:
            raise SlamError(f"{hint().argument('start')} {start} {hint().argument('until')} {until}: {until} comes before {start}")
        self._tell(f"{self.run.info()['dataset']} -> {self.run.path}")
        known: dict[str, State] = {}  # what holds is looked at once; whoever reads a file of it compares it again
        for index, stage in enumerate(STAGES[: last + 1]):
            known |= self.states(verify=True, until=stage.name, known=known)
            state = known[stage.name]
            if state.is_fresh and index < first_forced:
                self._tell(f"{stage.name:<9}  {state.state}")
                continue
            with at_work(stage.name):
                log.info("%s: begins: %s", stage.name, state.reason or state.state if index < first_forced else "asked for")
            self.run_stage(stage)
            del known[stage.name]
        if self.recording_note:
            log.warning("%s", self.recording_note)

    def run_alone(self, name: str) -> None:
        """Run one stage, even when it is up to date, from whatever its predecessors left."""
        stage, states = stage_named(name), self.states()
        needs = [states[n] for n in stage.needs if n != "dataset"]
        for need in reversed(needs):  # the latest first: its advice brings the others too
            if need.state == staleness.MISSING:
                raise SlamError(
                    f"{name} needs {need.stage}, which {self.run.why_missing(need.stage)}: {hint().update(self.run.path, until=need.stage)}"
                )
            if need.state == staleness.DAMAGED:
                raise SlamError(
                    f"{name} needs {need.stage}, which is damaged ({need.reason}); try: {hint().update(self.run.path, until=need.stage)}"
                )
        for need in needs:
            if not need.is_fresh:
                log.warning(
                    "%s rests on %s, which is stale (%s); bring it up to date with: %s",
                    name,
                    need.stage,
                    need.reason,
                    hint().update(self.run.path),
                )
        self.run_stage(stage)

    def run_stage(self, stage: Stage, *, begun: Begun | None = None) -> None:
        """Run one stage, or end one that was begun elsewhere, and put its folder in place; if it fails, the result before stays."""
        with at_work(stage.name):
            self._run_stage(stage, begun)

    def _run_stage(self, stage: Stage, begun: Begun | None) -> None:
        address_space.require()
        inputs = {name: self._present_input(name) for name in (*stage.needs, *staleness.named_files(stage, self.config))}
        tools = Tools(stage.name, self.config, self._progress)
        if stage is STAGES[0]:  # the record of the first stage is where the recording's own faults belong
            for warning in self.dataset().warnings:
                tools.warn(warning)
        compilation.ensure(progress=self._progress, tell=self._tell)
        with self.run.writing(stage.name) as out:
            try:
                from slamcli import mapped_memory

                with Meter() as meter, one_thread_in_blas(), mapped_memory.bounded(self.run.path):
                    module = importlib.import_module(f"slamcli.stages.{stage.name}")
                    meter.watch_compiler(self._tell)
                    run = module.run if begun is None else begun.go_on
                    summary = run(Inputs(stage, self.run, self.dataset), out, Settings(stage, self.config), tools)
                    if stage is STAGES[0]:
                        summary = doubt.joined(summary, self.looked)
            except (KeyboardInterrupt, SystemError) as error:
                if (found := interruption.found_in(error)) is None:
                    raise
                raise interruption.Interrupted(found.number, f" in {stage.name}; earlier stages are kept") from None
            if begun is not None:
                meter.add(seconds=begun.seconds, cpu_seconds=begun.cpu_seconds, peak_rss_mb=begun.peak_rss_mb)
            record = self._record(stage, inputs, damage.outputs(out), meter, tools, summary)
            self.run.commit(stage.name, out, record)
        for finding in doubt.from_records({stage.name: record}):
            if finding.text not in tools.warnings:
                log.info("%s: %s", stage.name, finding.text)
        log.debug("%s: %s", stage.name, _done_line(record))
        self._tell(stage_line(record, stage.told))
        return_free_memory(meter.taken_mb)

    def _present_input(self, name: str) -> str:
        if name in NAMES:
            return str((self.run.record(name) or {})["digest"])
        if name == "dataset":
            self._dataset_digest = self._dataset_digest or self.dataset().digest()
            return self._dataset_digest
        digest = self._input_digest(name)
        if digest is None:
            section, _, option = name.partition(".")
            raise SlamError(f"{name}: {getattr(getattr(self.config, section), option)} is not there")
        return digest

    def _record(
        self,
        stage: Stage,
        inputs: Mapping[str, str],
        outputs: Mapping[str, Mapping[str, Any]],
        meter: Meter,
        tools: Tools,
        summary: Mapping[str, Any],
    ) -> dict[str, Any]:
        info = self.run.info()
        reader = self.dataset().reader if "dataset" in stage.needs or "recordings" in info else ""
        declared, code = staleness.declared(stage, self.config), source_code.of_stage(stage.name, reader)
        frames = summary.get("frames")
        return {
            "format": FORMAT,
            "stage": stage.name,
            "key": staleness.key(declared, inputs, code),
            "config": declared,
            "inputs": dict(inputs),
            "code": dict(code),
            "reader": reader,
            "outputs": outputs,
            "digest": files.digest({name: entry["sha256"] for name, entry in outputs.items()}),
            "recording": {name: info[name] for name in ("dataset", "root", "recordings") if name in info},
            "environment": dict(environment()),
            "seconds": round(meter.seconds, 3),
            "cpu_seconds": round(meter.cpu_seconds, 3),
            "compile_seconds": round(meter.compile_seconds, 3),
            "fps": round(frames / meter.seconds, 2) if frames and meter.seconds > 0 else None,
            "peak_rss_mb": round(meter.peak_rss_mb, 1),
            "summary": _plain(summary),
            "warnings": tools.warnings,
            "n_warnings": tools.n_warnings,
        }


def _done_line(record: Mapping[str, Any]) -> str:
    """Tell in a line all that a finished stage counted, what it cost, and what it wrote; the rest is in its record."""
    mb = sum(entry["bytes"] for entry in record["outputs"].values()) / 1e6
    cost = f"CPU {record['cpu_seconds']:.1f} s  {record['peak_rss_mb']:.0f} MiB  {len(record['outputs'])} files of {mb:.1f} MB"
    return f"done  {stage_line(record, None).removeprefix(record['stage']).strip()}  {cost}  {record['digest']}"


def _plain(value: Any) -> Any:
    """Turn numpy scalars and arrays within a summary into JSON values; what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@functools.cache
def environment() -> Mapping[str, str]:
    """Name the versions a result may depend on; they are recorded and shown, and make nothing stale."""
    found = {"slamcli": __version__, "machine": platform.machine(), "python": platform.python_version()}
    for name, package in PACKAGES.items():
        try:
            found[name] = version(package)
        except PackageNotFoundError:  # another build of the same library, such as opencv-python
            found[name] = "unknown"
    return found
