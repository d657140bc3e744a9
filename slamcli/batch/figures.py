"""A batch's table: what became of each recording, as CSV and as a page."""

import csv
import html
import io
from collections.abc import Mapping, Sequence
from typing import Any

from slamcli import __version__
from slamcli.batch import storage
from slamcli.datasets import Dataset
from slamcli.errors import SlamError
from slamcli.evaluation import run_content
from slamcli.report import remarks
from slamcli.runs.run_directory import RunDir
from slamcli.stages import NAMES, WITH_TRAJECTORY

Row = Mapping[str, Any]

# name in the CSV: heading on the page, form of a number there
COLUMNS = {
    "recording": ("recording", ""),
    "state": ("state", ""),
    "frames": ("frames", "d"),
    "coverage": ("with a pose", ".1%"),
    "closures": ("loops closed", "d"),
    "ape_m": ("APE [m]", ".4f"),
    "map": ("map for a robot", ""),
    "seconds": ("time [s]", ".1f"),
    "cpu_seconds": ("CPU [s]", ".1f"),
    "peak_mib": ("peak memory [MiB]", ".0f"),
    "output_mb": ("output [MB]", ".1f"),
    "warnings": ("warnings", "d"),
    "doubt": ("doubt", ""),
    "reason": ("why it failed", ""),
    "run": ("run", ""),
}
ADDED_UP = ("frames", "seconds", "cpu_seconds", "output_mb", "warnings")
STYLE = """body{font:15px/1.45 system-ui,sans-serif;margin:2em;color:#1c2733}table{border-collapse:collapse}
th,td{padding:.3em .7em;border-bottom:1px solid #d5dde5;text-align:left;vertical-align:top}td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}
tr.failed td{background:#fdeeee}tr.doubted td{background:#fff8e5}tfoot td{font-weight:600}"""


def of_run(run: RunDir, dataset: Dataset | None = None) -> dict[str, Any]:
    """Return the figures of a run as far as it went: coverage, APE where there is truth, what to doubt, and what it cost.

    dataset : the recording, where it is open already
    """
    records = [record for name in NAMES if (record := run.record(name)) is not None]
    found: dict[str, Any] = {
        "seconds": round(sum(record["seconds"] for record in records), 1),
        "cpu_seconds": round(sum(record["cpu_seconds"] for record in records), 1),
        "peak_mib": max((record["peak_rss_mb"] for record in records), default=None),
        "output_mb": round(sum(entry["bytes"] for record in records for entry in record["outputs"].values()) / 1e6, 1),
        "warnings": sum(record["n_warnings"] for record in records),
    }
    for record in records:
        found |= {name: record["summary"][name] for name in ("frames", "closures") if name in record["summary"]}
    return found | (_judged(run, dataset) if any(record["stage"] in WITH_TRAJECTORY for record in records) else {})


def _judged(run: RunDir, dataset: Dataset | None) -> dict[str, Any]:
    try:
        content = run_content.collect(run, dataset)
    except SlamError:  # a recording that failed half-way: the reason stands in its row
        return {}
    ape = content.ape.get(content.stage)
    grave = [remark.text for remark in remarks.collect(content) if remark.kind == remarks.BAD]
    return {
        "coverage": round(float(content.has_pose.mean()), 4),
        "ape_m": round(ape.to_dict()["rmse"], 5) if ape else None,
        "map": "" if content.verdict is None else "usable" if content.verdict.is_usable else "not usable",
        "doubt": " ".join(grave),
    }


def write(out: str, rows: Sequence[Row]) -> list[str]:
    """Write ``batch.csv`` and ``batch.html`` into the folder of the runs, here or elsewhere; returns where they are."""
    written = {f"{out}/batch.csv": as_csv(rows), f"{out}/batch.html": as_page(rows)}
    for place, text in written.items():
        storage.write_text(place, text)
    return list(written)


def as_csv(rows: Sequence[Row]) -> str:
    """Write a line a recording."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(COLUMNS), restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if row.get(name) is None else row[name] for name in COLUMNS} for row in rows)
    return text.getvalue()


def as_page(rows: Sequence[Row]) -> str:
    """Write the page: failed recordings first, then those to doubt; every text from outside is escaped."""
    n_failed = sum(row["state"] == "failed" for row in rows)
    n_doubted = sum(bool(row.get("doubt")) for row in rows)
    title = f"{len(rows)} recordings: {len(rows) - n_failed} done, {n_failed} failed, {n_doubted} to doubt"
    head = "".join(f"<th{_class(name)}>{html.escape(COLUMNS[name][0])}</th>" for name in COLUMNS)
    body = "".join(_line(row) for row in sorted(rows, key=lambda row: (row["state"] != "failed", not row.get("doubt"))))
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style></head>'
        f"<body><h1>{title}</h1><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody><tfoot>{_total(rows)}</tfoot></table>"
        f"<p>slamcli {__version__}</p></body></html>\n"
    )


def _line(row: Row) -> str:
    kind = "failed" if row["state"] == "failed" else "doubted" if row.get("doubt") else ""
    return (
        f'<tr class="{kind}">' + "".join(f"<td{_class(name)}>{html.escape(_shown(name, row.get(name)))}</td>" for name in COLUMNS) + "</tr>"
    )


def _total(rows: Sequence[Row]) -> str:
    total = {name: sum(row.get(name) or 0 for row in rows) for name in ADDED_UP} | {"recording": "all"}
    return "<tr>" + "".join(f"<td{_class(name)}>{html.escape(_shown(name, total.get(name)))}</td>" for name in COLUMNS) + "</tr>"


def _class(name: str) -> str:
    return ' class="n"' if COLUMNS[name][1] else ""


def _shown(name: str, value: Any) -> str:
    return "" if value is None or value == "" else format(value, COLUMNS[name][1])


def as_line(row: Row) -> str:
    """Tell one recording in a line."""
    if row["state"] == "failed":
        return f"{row['recording']}: failed: {row['reason']}"
    parts = [f"{row['coverage']:.1%} of {row['frames']} frames" if "coverage" in row else f"{row.get('frames', 0)} frames"]
    parts += [f"APE {row['ape_m']:.4f} m"] if row.get("ape_m") is not None else []
    parts += [f"{row['cpu_seconds']:.1f} s of CPU time"]
    parts += ["to doubt"] if row.get("doubt") else []
    return f"{row['recording']}: done, {', '.join(parts)}"
