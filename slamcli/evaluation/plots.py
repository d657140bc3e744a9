"""Pictures of errors and trajectories, as [Z] Fig. 7 (error over time) and Fig. 8 (trajectories against the truth)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.evaluation.trajectory_error import Ape, Rpe, rmse, statistics

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31")  # told apart by colour-blind eyes too
TRUTH_COLOUR = "#555555"
SUFFIXES = (".png", ".pdf", ".svg")
GAP = 0.5  # [s] without a pose: the line is broken there instead of drawn across


def plot_ape(results: Sequence[Ape], path: Path) -> None:
    """Draw error over time above and trajectories against the truth, from two sides, below."""
    figure = _figure(path, height=9.0)
    rows = figure.add_gridspec(2, 2, height_ratios=(1.0, 1.25))
    over_time = figure.add_subplot(rows[0, :])
    start = min(result.stamp[0] for result in results)
    for colour, result in zip(_colours(results), results, strict=True):
        label = f"{label_of(result)}: RMSE {result.rmse:.4f} m, {100 * result.coverage:.1f} % of frames"
        over_time.plot(*_with_gaps(result.stamp, result.stamp - start, result.error), color=colour, lw=1.1, label=label)
        if len(results) == 1:
            for name, style in (("rmse", "-"), ("mean", "--"), ("median", ":")):
                value = statistics(result.error)[name]
                over_time.axhline(value, color=TRUTH_COLOUR, ls=style, lw=0.9, label=f"{name} {value:.4f} m")
    _finish(over_time, "time [s]", "absolute pose error [m]", from_zero=True)
    for column, axes in enumerate(view_axes(results[0].x_truth)):
        _draw_trajectories(figure.add_subplot(rows[1, column]), results, axes)
    _save(figure, path)


def plot_rpe(results: Sequence[Rpe], path: Path) -> None:
    """Draw relative errors over time, translation above, rotation below."""
    figure = _figure(path, height=7.0)
    translation, rotation = figure.subplots(2, 1, sharex=True)
    start = min(result.stamp[0] for result in results)
    for colour, result in zip(_colours(results), results, strict=True):
        t = result.stamp - start
        label = f"{label_of(result)}: RMSE {rmse(result.translation):.4f} m"
        translation.plot(*_with_gaps(result.stamp, t, result.translation), color=colour, lw=1.0, label=label)
        label = f"{label_of(result)}: RMSE {rmse(result.rotation_deg):.3f} deg"
        rotation.plot(*_with_gaps(result.stamp, t, result.rotation_deg), color=colour, lw=1.0, label=label)
    interval = f"{results[0].delta:g} {results[0].unit}"
    _finish(translation, "", f"translation error over {interval} [m]", from_zero=True)
    _finish(rotation, "time [s]", f"rotation error over {interval} [deg]", from_zero=True)
    _save(figure, path)


def label_of(result: Ape | Rpe) -> str:
    """Name a result in a legend."""
    return f"{result.name} ({result.stage})" if result.stage else result.name


def view_axes(x_truth: np.ndarray) -> tuple[tuple[int, int], tuple[int, int]]:
    """Choose two views of points (N, 3): first along the axis of least extent, then along that of the second least."""
    extent = np.ptp(x_truth, axis=0)
    least, middle, _ = np.argsort(extent, kind="stable")
    views = [tuple(axis for axis in range(3) if axis != hidden) for hidden in (least, middle)]
    return (views[0][0], views[0][1]), (views[1][0], views[1][1])


def _draw_trajectories(axis: Any, results: Sequence[Ape], axes: tuple[int, int]) -> None:
    for result in results:
        truth = _with_gaps(result.stamp, result.x_truth[:, axes[0]], result.x_truth[:, axes[1]])
        axis.plot(*truth, color=TRUTH_COLOUR, ls="--", lw=1.4, label="ground truth" if result is results[0] else None)
    for colour, result in zip(_colours(results), results, strict=True):
        estimate = _with_gaps(result.stamp, result.x_aligned[:, axes[0]], result.x_aligned[:, axes[1]])
        axis.plot(*estimate, color=colour, lw=1.1, label=label_of(result))
    axis.set_aspect("equal", adjustable="datalim")
    _finish(axis, f"{'xyz'[axes[0]]} [m]", f"{'xyz'[axes[1]]} [m]")


def _with_gaps(stamp: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """Put a NaN where the recording has no pose for a while."""
    gaps = np.flatnonzero(np.diff(stamp) > GAP) + 1
    return [np.insert(np.asarray(column, dtype=np.float64), gaps, np.nan) for column in columns]


def _colours(results: Sequence[Any]) -> list[str]:
    return [COLOURS[i % len(COLOURS)] for i in range(len(results))]


def _figure(path: Path, *, height: float) -> Any:
    if path.suffix.lower() not in SUFFIXES:
        raise SlamError(f"{path}: not a kind of picture that can be drawn; name it {', '.join('*' + suffix for suffix in SUFFIXES)}")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _finish(axis: Any, xlabel: str, ylabel: str, *, from_zero: bool = False) -> None:
    axis.set_xlabel(xlabel)
    axis.set_ylabel(ylabel)
    axis.grid(True, color="#dddddd", lw=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    if from_zero:
        axis.set_ylim(bottom=0.0)
    axis.legend(loc="best", fontsize=8, framealpha=0.85)


def _save(figure: Any, path: Path) -> None:
    with files.whole(path) as file:
        figure.savefig(file, format=Path(path).suffix[1:].lower(), dpi=130)
