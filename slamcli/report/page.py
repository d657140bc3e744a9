"""The page itself: a template, a style sheet and a script, filled in. Every text from outside is escaped."""

import html
import json
import platform
import re
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import resources
from typing import Any

import numpy as np

from slamcli import __version__
from slamcli.config.options import Config
from slamcli.console import counts
from slamcli.evaluation.run_content import Content
from slamcli.report import doubts
from slamcli.report.pictures import Picture

MOST_TRUTH_POINTS = 6000


def render(content: Content, pictures: list[Picture], inspected: Sequence[tuple[str, str]] = ()) -> str:
    """Fill the template; `inspected` are findings on the recording, as `report.make` takes them."""
    parts = {
        "title": html.escape(f"slamcli report: {content.name}"),
        "name": html.escape(content.name),
        "headline": html.escape(doubts.headline(content)),
        "cards": _cards(content),
        "remarks": _remarks(doubts.remarks(content, inspected)),
        "errors": _errors(content),
        "maps": "".join(_picture(picture) for picture in pictures)
        or f"<p>No map has been made yet; go on with: slamcli run {html.escape(content.flag)}</p>",
        "timings": _timings(content),
        "recording": _pairs({"folder": content.recording["root"], **content.recording["camera"]}),
        "configuration": _configuration(content),
        "versions": _pairs(_versions(content)),
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "data": json.dumps(_data(content), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "style": resource("page.css"),
        "script": resource("page.js"),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found.group(1)], resource("page.html"))


def resource(name: str) -> str:
    """Read a file of this package."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _data(content: Content) -> dict[str, Any]:
    """Return what the interactive parts draw: missing values are null."""
    ape = content.ape.get(content.stage)
    error = np.full(len(content.stamp), np.nan)
    if ape is not None:
        error[np.searchsorted(content.stamp, ape.stamp)] = ape.error
    step = -(-len(content.x_truth) // MOST_TRUTH_POINTS) or 1
    rotation = content.T_lc[:, :3, :3]
    return {
        "time": _numbers(content.stamp - content.stamp[0], 4),
        "position": [_numbers(content.T_lc[:, k, 3], 4) for k in range(3)],
        "forward": [_numbers(rotation[:, k, 2], 3) for k in range(3)],
        "right": [_numbers(rotation[:, k, 0], 3) for k in range(3)],
        "state": content.state.tolist(),
        "inliers": content.n_inliers.tolist(),
        "features": content.n_features.tolist(),
        "error": _numbers(error, 6) if ape is not None else [],
        "truth": [_numbers(content.x_truth[::step, k], 4) for k in range(3)],
        "loops": content.loops.tolist(),
        "hasFloor": bool(content.ground is not None and content.ground.is_found),
    }


def _numbers(values: np.ndarray, digits: int) -> list[float | None]:
    return [round(float(value), digits) if np.isfinite(value) else None for value in values]


def _cards(content: Content) -> str:
    n, n_poses = len(content.stamp), int(content.has_pose.sum())
    records = [state.record for state in content.states.values() if state.record]
    seconds = sum(record["seconds"] - record.get("compile_seconds", 0.0) for record in records)
    cards = [
        ("frames located", f"{n_poses} / {n}"),
        ("key frames", content.summary("track").get("key_frames")),
        ("loops closed", len(content.loops)),
    ]
    if content.ape.get(content.stage):
        cards.insert(0, ("APE RMSE", f"{1000 * content.ape[content.stage].rmse:.1f} mm"))
    if content.verdict is not None:
        cards.insert(1, ("free floor", f"{content.verdict.evidence.free_area:.1f} m\u00b2"))
    cards += [
        ("landmarks", content.summary(content.stage).get("landmarks")),
        ("cloud points", content.summary("densify").get("points")),
        ("time per frame", f"{1000 * seconds / n:.0f} ms"),
        ("peak memory", f"{max(record.get('peak_rss_mb', 0.0) for record in records):.0f} MiB"),
    ]
    is_amber = content.verdict is not None and not content.verdict.is_usable
    return "".join(
        f'<div class="card{" amber" if name == "free floor" and is_amber else ""}"><b>{html.escape(_thousands(value))}</b><span>{name}</span></div>'
        for name, value in cards
        if value is not None
    )


def _thousands(value: Any) -> str:
    return f"{value:,}".replace(",", "\u202f") if isinstance(value, int) else str(value)


def _remarks(remarks: list[doubts.Remark]) -> str:
    return "".join(f'<li class="{remark.kind}">{html.escape(remark.text)}</li>' for remark in remarks)


def _errors(content: Content) -> str:
    """Tabulate the error after each stage."""
    if not content.ape:
        return f"<p>{html.escape(content.no_truth or 'Too few poses to compare with the ground truth.')}</p>"
    rows = []
    for stage, ape in content.ape.items():
        figures = ape.to_dict()
        cells = [f"{figures[key]:.4f}" for key in ("rmse", "mean", "median", "std", "max")]
        cells += [f"{figures['n_poses']} / {figures['n_frames']}", f"{figures['scale']:.4f}", f"{figures['rmse_scaled']:.4f}"]
        rows.append([stage, *cells])
    heading = ["after", "RMSE [m]", "mean", "median", "std", "max", "poses", "scale", "RMSE scaled"]
    note = (
        "Absolute pose error after SE(3) alignment without scale, poses within 0.02 s of a true one; "
        "the scale-fitted figures stand beside it."
    )
    return _table(heading, rows) + f'<p class="small">{note}</p>'


def _timings(content: Content) -> str:
    """Tabulate what each stage cost; compiling kernels, which happens once on a machine, is kept apart."""
    records = {stage: state.record for stage, state in content.states.items() if state.record}
    compiling = {stage: record.get("compile_seconds", 0.0) for stage, record in records.items()}
    seconds = {stage: record["seconds"] - compiling[stage] for stage, record in records.items()}
    cpu = {stage: record.get("cpu_seconds", 0.0) - compiling[stage] for stage, record in records.items()}
    total, n = sum(seconds.values()) or 1.0, len(content.stamp)
    rows, bars = [], []
    for k, (stage, record) in enumerate(records.items()):
        bars.append(f'<i style="width:{100 * seconds[stage] / total:.2f}%" class="c{k}" title="{stage}: {seconds[stage]:.1f} s"></i>')
        rate = f"{n / seconds[stage]:.1f}" if seconds[stage] > 0 else "-"
        cells = [f"{seconds[stage]:.2f}", f"{cpu[stage]:.2f}", f"{compiling[stage]:.2f}", rate, f"{record.get('peak_rss_mb', 0.0):.0f}"]
        rows.append([f"\u25a0 {stage}", content.states[stage].state, *cells, ", ".join(counts(record.get("summary", {})))])
    sums = [f"{total:.2f}", f"{sum(cpu.values()):.2f}", f"{sum(compiling.values()):.2f}", f"{n / total:.1f}"]
    rows.append(["total", "", *sums, "", f"{1000 * sum(cpu.values()) / n:.0f} ms CPU time a frame"])
    heading = ["stage", "state", "seconds", "CPU seconds", "compiling", "frames/s", "peak MiB", "counts"]
    return f'<div class="bar">{"".join(bars)}</div>' + _table(heading, rows, css="timings")


def _configuration(content: Content) -> str:
    """List the configuration each stage ran with; what differs from the default is marked."""
    defaults = _flat(json.loads(json.dumps(asdict(Config()))))
    used: dict[str, Any] = {}
    for state in content.states.values():
        used |= _flat(state.record.get("config", {}))
    rows = []
    for name, value in used.items():
        is_changed = value != defaults.get(name)
        text = html.escape(json.dumps(value)) + (" (changed)" if is_changed else "")
        rows.append(f'<tr class="{"changed" if is_changed else ""}"><td>{html.escape(name)}</td><td>{text}</td></tr>')
    return f"<table>{''.join(rows)}</table>"


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


def _picture(picture: Picture) -> str:
    image = f'<img src="{picture.url}" alt="{html.escape(picture.title)}" tabindex="0">' if picture.url else ""
    return f"<figure><h3>{html.escape(picture.title)}</h3>{image}<figcaption>{html.escape(picture.caption)}</figcaption></figure>"


def _pairs(values: dict[str, Any]) -> str:
    return _table([], [[name, value] for name, value in values.items()])


def _table(heading: list[str], rows: list[list[Any]], css: str = "") -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heading)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return (
        f'<div class="scroll"><table class="{css}">{f"<thead><tr>{head}</tr></thead>" if head else ""}<tbody>{body}</tbody></table></div>'
    )
