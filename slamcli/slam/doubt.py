"""Doubt: independent signs that a result may be wrong, and what follows from them for single frames and for the whole run.

A stage tests what it knows and puts the findings in its summary, under "doubts": what is said there the command line, the report and the
exports repeat. A finding names the likely cause and the next step in one sentence; a grave one puts the whole result in doubt.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

DOUBTS = "doubts"  # key in a stage's summary
SEE_REPORT = "; the report shows which"  # ends a finding that names no frame; the report itself says it otherwise
MANY = 0.2  # share of doubtful frames from which on a run is doubtful as a whole
# What explains what: streams that hold no measurements look as if depth lay off colour, and either looks like a wrong calibration to the
# map. Where a grave finding of one line is there, those of the lines below are no news.
CAUSES = (
    frozenset({"frozen", "frozen_colour", "frozen_depth", "depth_readings"}),
    frozenset({"registration", "depth_delay"}),
    frozenset({"focal_length", "principal_point", "lens", "depth_shift"}),
)


@dataclass(frozen=True)
class Finding:
    """A sign that the result may be wrong."""

    name: str  # of the sign, such as "moving_objects" or "focal_length"
    text: str  # a sentence for the user: what was seen, with a number, what is likely wrong, and what to do
    is_grave: bool = False  # whether the whole result is in doubt


def to_summary(findings: Iterable[Finding]) -> dict[str, Any]:
    """Return the part of a stage's summary that keeps findings; nothing where there are none."""
    found = [asdict(finding) for finding in findings]
    return {DOUBTS: found} if found else {}


def joined(summary: Mapping[str, Any], findings: Iterable[Finding]) -> dict[str, Any]:
    """Add findings to those that a stage's summary keeps already."""
    added = to_summary(findings)
    return {**summary, DOUBTS: [*summary.get(DOUBTS, []), *added[DOUBTS]]} if added else dict(summary)


def from_records(records: Mapping[str, Mapping[str, Any] | None]) -> list[Finding]:
    """Collect the findings of all stages' records, the grave ones first; those that others explain are left out."""
    rows = [row for record in records.values() if record is not None for row in record.get("summary", {}).get(DOUBTS, [])]
    findings = dict.fromkeys(Finding(str(row["name"]), str(row["text"]), bool(row["is_grave"])) for row in rows)
    first = next((k for k, names in enumerate(CAUSES) if any(one.is_grave and one.name in names for one in findings)), len(CAUSES))
    explained = frozenset[str]().union(*CAUSES[first + 1 :])
    return sorted((finding for finding in findings if finding.name not in explained), key=lambda finding: not finding.is_grave)


def headline(findings: Iterable[Finding]) -> str:
    """Sum grave findings up in one line, "" where there are none."""
    grave = [finding.text for finding in findings if finding.is_grave]
    return f"DOUBTFUL: {'; '.join(grave)}" if grave else ""


def doubtful_frames(is_doubtful: np.ndarray) -> list[tuple[int, int]]:
    """List the stretches (first, last) of doubtful frames (F,) bool."""
    edge = np.flatnonzero(np.diff(np.concatenate([[False], is_doubtful, [False]]).astype(np.int8)))
    return [(int(first), int(last) - 1) for first, last in zip(edge[::2], edge[1::2], strict=True)]
