"""The page itself: what the template shows, as texts."""

import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from markupsafe import Markup

from slamcli import __version__
from slamcli.config.options import Config
from slamcli.console import counts
from slamcli.evaluation.run_content import Content
from slamcli.report import remarks
from slamcli.report.pictures import Picture
from slamcli.report.template import fill, resource, thousands

PAUSE = 1.0  # [s] in the charts between two recordings, however long they lie apart


@dataclass(frozen=True)
class Card:
    """One figure at the top of the page."""

    name: str
    value: str
    is_amber: bool = False


@dataclass(frozen=True)
class TextTable:
    """A table of texts."""

    heading: list[str]
    rows: list[list[str]]


@dataclass(frozen=True)
class Bar:
    """A stage's share [%] of the time."""

    share: str
    title: str


@dataclass(frozen=True)
class Used:
    """An option with the value that a stage ran with."""

    name: str
    value: str
    is_changed: bool  # from the default


def render(content: Content, pictures: list[Picture], inspected: Sequence[tuple[str, str]] = ()) -> str:
    """Fill the template; `inspected` are findings on the recording, as `report.make` takes them."""
    bars, timings = _timings(content)
    data = json.dumps(_data(content), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return fill(
        "page.html",
        name=content.name,
        update=content.update,
        headline=remarks.headline(content),
        cards=_cards(content),
        remarks=remarks.collect(content, inspected),
        errors=_errors(content),
        no_errors=content.no_truth or "Too few poses to compare with the ground truth.",
        pictures=pictures,
        bars=bars,
        timings=timings,
        recording=list(
            {"folder": content.recording["root"], **content.recording.get("recordings", {}), **content.recording["camera"]}.items()
        ),
        configuration=_configuration(content),
        versions=list(_versions(content).items()),
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        data=Markup(data),
        script=Markup(resource("page.js")),
    )


def _data(content: Content) -> dict[str, Any]:
    """Return what the interactive parts draw: missing values are null."""
    ape = content.ape.get(content.stage)
    error = np.full(len(content.stamp), np.nan)
    if ape is not None:
        error[np.searchsorted(content.stamp, ape.stamp)] = ape.error
    rotation = content.T_lc[:, :3, :3]
    return {
        "time": _numbers(_time(content), 4),
        "starts": content.starts.tolist(),
        "names": content.names if len(content.starts) > 1 else [],
        "position": [_numbers(content.T_lc[:, k, 3], 4) for k in range(3)],
        "forward": [_numbers(rotation[:, k, 2], 3) for k in range(3)],
        "right": [_numbers(rotation[:, k, 0], 3) for k in range(3)],
        "state": content.state.tolist(),
        "inliers": content.n_inliers.tolist(),
        "features": content.n_features.tolist(),
        "doubtful": np.flatnonzero(content.is_doubtful).tolist(),
        "error": _numbers(error, 6) if ape is not None else [],
        "truth": [_numbers(content.x_truth[:, k], 4) for k in range(3)],
        "loops": content.loops.tolist(),
        "hasFloor": bool(content.ground is not None and content.ground.is_found),
    }


def _time(content: Content) -> np.ndarray:
    """Return when each frame was taken (F,) [s], one recording soon after the other."""
    since = content.stamp - content.stamp[0]
    for first in content.starts[1:]:
        since[first:] -= since[first] - since[first - 1] - PAUSE
    return since


def _numbers(values: np.ndarray, digits: int) -> list[float | None]:
    return [round(float(value), digits) if np.isfinite(value) else None for value in values]


def _cards(content: Content) -> list[Card]:
    n, n_poses = len(content.stamp), int(content.has_pose.sum())
    records = [state.record for state in content.states.values() if state.record]
    seconds = sum(record["seconds"] - record.get("compile_seconds", 0.0) for record in records)
    ape, verdict = content.ape.get(content.stage), content.verdict
    cards = [
        Card("APE RMSE", f"{1000 * ape.rmse:.1f} mm") if ape else None,
        Card("free floor", f"{verdict.evidence.free_area:.1f} m\u00b2", not verdict.is_usable) if verdict is not None else None,
        Card("frames located", f"{n_poses} / {n}"),
        _count("key frames", content.summary("track").get("key_frames")),
        _count("loops closed", len(content.loops)),
        _count("landmarks", content.summary(content.stage).get("landmarks")),
        _count("cloud points", content.summary("densify").get("points")),
        Card("time per frame", f"{1000 * seconds / n:.0f} ms"),
        Card("peak memory", f"{max(record.get('peak_rss_mb', 0.0) for record in records):.0f} MiB"),
    ]
    return [card for card in cards if card is not None]


def _count(name: str, value: int | None) -> Card | None:
    return None if value is None else Card(name, thousands(value))


def _errors(content: Content) -> TextTable | None:
    """Tabulate the error after each stage."""
    rows = []
    for stage, ape in [*content.ape.items(), *((one.name, one) for one in content.ape_of)]:
        figures = ape.to_dict()
        cells = [f"{figures[key]:.4f}" for key in ("rmse", "mean", "median", "std", "max")]
        cells += [f"{figures['n_poses']} / {figures['n_frames']}", f"{figures['scale']:.4f}", f"{figures['rmse_scaled']:.4f}"]
        rows.append([stage, *cells])
    heading = ["after", "RMSE [m]", "mean", "median", "std", "max", "poses", "scale", "RMSE scaled"]
    return TextTable(heading, rows) if rows else None


def _timings(content: Content) -> tuple[list[Bar], TextTable]:
    """Tabulate what each stage cost; compiling kernels, which happens once on a machine, is kept apart."""
    records = {stage: state.record for stage, state in content.states.items() if state.record}
    compiling = {stage: record.get("compile_seconds", 0.0) for stage, record in records.items()}
    seconds = {stage: record["seconds"] - compiling[stage] for stage, record in records.items()}
    cpu = {stage: record.get("cpu_seconds", 0.0) - compiling[stage] for stage, record in records.items()}
    total, n = sum(seconds.values()) or 1.0, len(content.stamp)
    bars = [Bar(f"{100 * seconds[stage] / total:.2f}", f"{stage}: {seconds[stage]:.1f} s") for stage in records]
    rows = []
    for stage, record in records.items():
        rate = f"{n / seconds[stage]:.1f}" if seconds[stage] > 0 else "-"
        cells = [f"{seconds[stage]:.2f}", f"{cpu[stage]:.2f}", f"{compiling[stage]:.2f}", rate, f"{record.get('peak_rss_mb', 0.0):.0f}"]
        rows.append([f"\u25a0 {stage}", content.states[stage].state, *cells, ", ".join(counts(record.get("summary", {})))])
    sums = [f"{total:.2f}", f"{sum(cpu.values()):.2f}", f"{sum(compiling.values()):.2f}", f"{n / total:.1f}"]
    rows.append(["total", "", *sums, "", f"{1000 * sum(cpu.values()) / n:.0f} ms CPU time a frame"])
    return bars, TextTable(["stage", "state", "seconds", "CPU seconds", "compiling", "frames/s", "peak MiB", "counts"], rows)


def _configuration(content: Content) -> list[Used]:
    """List the configuration each stage ran with."""
    defaults = _flat(json.loads(json.dumps(asdict(Config()))))
    used: dict[str, Any] = {}
    for state in content.states.values():
        used |= _flat(state.record.get("config", {}))
    return [Used(name, json.dumps(value), value != defaults.get(name)) for name, value in used.items()]


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for section, value in values.items():
        flat |= {f"{section}.{key}": item for key, item in value.items()} if isinstance(value, dict) else {section: value}
    return flat


def _versions(content: Content) -> dict[str, Any]:
    versions: dict[str, Any] = {
        "this page": f"slamcli {__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    }
    for stage, state in content.states.items():
        for name, version in state.record.get("environment", {}).items():
            made = versions.setdefault(name, {})
            made.setdefault(version, []).append(stage)
    return {name: value if isinstance(value, str) else _by_version(value) for name, value in versions.items()}


def _by_version(stages: dict[str, list[str]]) -> str:
    if len(stages) == 1:
        return next(iter(stages))
    return "; ".join(f"{version} ({', '.join(made)})" for version, made in stages.items())
