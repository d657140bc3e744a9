"""Several runs side by side: what was set, what it cost, how good it is, and where the maps differ from the first run's."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from slamcli.config import toml
from slamcli.errors import Damaged, SlamError
from slamcli.evaluation import map_verdict, run_trajectories, trajectory_error
from slamcli.evaluation.map_verdict import Verdict
from slamcli.formats import cloud
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Grid
from slamcli.stages import NAMES

SAMPLED_POINTS = 20_000  # of a cloud, evenly spread over its file, are measured against the other cloud


@dataclass(frozen=True)
class MapDifference:
    """How a run's maps differ from another's. None where either lacks them, or they cannot be laid over each other."""

    cells_flipped: float | None  # share of the grid cells known to both that are free in one and occupied in the other
    cells_known: float | None  # share of the other's known cells that are known here too
    cloud_median: float | None  # [m] from this cloud's points to the nearest of the other
    cloud_p95: float | None  # [m]


@dataclass(frozen=True)
class ComparedRun:
    """One run among those compared."""

    name: str
    settings: dict[str, Any]  # of the options in which the runs differ, by full name
    same_output: list[str]  # stages whose output is, byte for byte, that of the first run
    seconds: float
    cpu_seconds: float
    ape: float | None  # [m] RMSE of the last trajectory, where the recording has truth
    frames: int
    located: int
    verdict: Verdict | None
    difference: MapDifference | None  # to the first run; None of the first itself

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        verdict = self.verdict.to_dict() if self.verdict is not None else None
        return asdict(self) | {"coverage": self.located / max(self.frames, 1), "verdict": verdict}


def compare(runs: Sequence[RunDir], names: Sequence[str]) -> list[ComparedRun]:
    """Compare runs of one recording, or of several, with the first of them; SlamError where one has no trajectory yet."""
    settings = differing_settings([_flat(asdict(run.config())) for run in runs])
    first = {stage: (runs[0].record(stage) or {}).get("digest") for stage in NAMES}
    return [_compared(run, name, own, first, runs[0]) for run, name, own in zip(runs, names, settings, strict=True)]


def differing_settings(configs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Reduce flat configurations to the options in which they differ from each other."""
    keys = [key for key in configs[0] if any(config.get(key) != configs[0][key] for config in configs)]
    keys += sorted({key for config in configs for key in config if key not in configs[0]})
    return [{key: config.get(key) for key in keys} for config in configs]


def _compared(run: RunDir, name: str, settings: dict[str, Any], first: dict[str, Any], reference: RunDir) -> ComparedRun:
    records = {stage: record for stage in NAMES if (record := run.record(stage)) is not None}
    estimate = run_trajectories.stage_trajectory(run, run_trajectories.last_stage(run))
    return ComparedRun(
        name=name,
        settings=settings,
        same_output=[stage for stage, record in records.items() if record["digest"] == first[stage]],
        seconds=sum(record["seconds"] - record["compile_seconds"] for record in records.values()),
        cpu_seconds=sum(record["cpu_seconds"] - record["compile_seconds"] for record in records.values()),
        ape=_ape(run, name),
        frames=run_trajectories.frame_count(run),
        located=len(estimate.stamp),
        verdict=map_verdict.of_run(run),
        difference=None if run is reference else map_difference(run, reference),
    )


def _ape(run: RunDir, name: str) -> float | None:
    try:
        truth, stage = run_trajectories.ground_truth(run), run_trajectories.last_stage(run)
        found = trajectory_error.ape(
            run_trajectories.stage_trajectory(run, stage), truth, n_frames=run_trajectories.frame_count(run), name=name, stage=stage
        )
    except Damaged:
        raise
    except SlamError:  # no truth, too few poses, or the recording is gone: there is nothing to compare with
        return None
    return found.rmse


def map_difference(run: RunDir, other: RunDir) -> MapDifference:
    """Measure how the grid and the cloud of a run differ from another's; both have their origin below the recording's first camera."""
    flipped = known = None
    if all(one.record("grid2d") is not None for one in (run, other)):
        flipped, known = grid_difference(run.load(Grid, "grid2d"), other.load(Grid, "grid2d"))
    median = p95 = None
    if all(one.record("densify") is not None for one in (run, other)):
        median, p95 = cloud_distance(*(cloud.read_ply(one.stage_path("densify", "cloud.ply"))[0] for one in (run, other)))
    return MapDifference(flipped, known, median, p95)


def grid_difference(grid: Grid, other: Grid) -> tuple[float | None, float | None]:
    """Compare the cells of two grids of one resolution: the share flipped of those both know, and the share of the other's known here.

    None where there is nothing to compare.
    """
    if not np.isclose(grid.resolution, other.resolution):
        return None, None
    shift = np.rint((grid.origin - other.origin) / float(other.resolution)).astype(int)
    rows, columns = np.nonzero(other.state >= 0)
    here_rows, here_columns = rows - shift[1], columns - shift[0]
    inside = (here_rows >= 0) & (here_columns >= 0) & (here_rows < grid.state.shape[0]) & (here_columns < grid.state.shape[1])
    state = np.full(len(rows), -1, dtype=np.int8)
    state[inside] = grid.state[here_rows[inside], here_columns[inside]]
    both = state >= 0
    flipped = float((state[both] != other.state[rows[both], columns[both]]).mean()) if both.any() else None
    return flipped, float(both.mean()) if len(both) else None


def cloud_distance(xyz: np.ndarray, other: np.ndarray) -> tuple[float | None, float | None]:
    """Return the median and the 95 % quantile [m] of the distances from points (N, 3) to the nearest of another cloud (M, 3)."""
    from scipy.spatial import cKDTree

    if not len(xyz) or not len(other):
        return None, None
    sampled = xyz[np.unique(np.linspace(0, len(xyz) - 1, min(len(xyz), SAMPLED_POINTS)).astype(int))]
    distance, _ = cKDTree(other).query(sampled)
    return float(np.median(distance)), float(np.quantile(distance, 0.95))


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    """Flatten a configuration; what does not change a result, run.*, is left out."""
    flat: dict[str, Any] = {}
    for section, value in config.items():
        if section != "run":
            flat |= {f"{section}.{key}": item for key, item in value.items()} if isinstance(value, dict) else {section: value}
    return flat


FIGURES = ("time [s]", "CPU time [s]", "APE RMSE [mm]", "frames located", "free floor [m2]", "map", "same output as the first",
           "grid cells flipped", "grid cells known to both", "cloud distance, median [mm]", "cloud distance, 95 % [mm]")  # fmt: skip


def rows(compared: Sequence[ComparedRun]) -> list[list[str]]:
    """Tabulate the runs: a row per option that differs and per figure, a column per run; the first row names them."""
    columns = [_column(one) for one in compared]
    table = [["", *(one.name for one in compared)]]
    table += [[key, *(toml.as_text(one.settings[key]) for one in compared)] for key in compared[0].settings]
    return table + [[figure, *(column[i] for column in columns)] for i, figure in enumerate(FIGURES)]


def _column(one: ComparedRun) -> list[str]:
    causes = [finding.cause for finding in one.verdict.findings] if one.verdict is not None else []
    return [
        f"{one.seconds:.1f}",
        f"{one.cpu_seconds:.1f}",
        _number(one.ape, 1000.0, ".2f"),
        f"{one.located} of {one.frames}",
        f"{one.verdict.evidence.free_area:.1f}" if one.verdict is not None else "-",
        "-" if one.verdict is None else ", ".join(causes) or "usable",
        *_against_the_first(one),
    ]


def _against_the_first(one: ComparedRun) -> list[str]:
    found = one.difference
    if found is None:
        return ["-"] * 5
    return [
        "all" if len(one.same_output) == len(NAMES) else ", ".join(one.same_output) or "none",
        _number(found.cells_flipped, 1.0, ".2%"),
        _number(found.cells_known, 1.0, ".1%"),
        _number(found.cloud_median, 1000.0, ".1f"),
        _number(found.cloud_p95, 1000.0, ".1f"),
    ]


def _number(value: float | None, scale: float, form: str) -> str:
    return "-" if value is None else format(scale * value, form)
