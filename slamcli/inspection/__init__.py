"""What is wrong with a recording, before time is spent on it.

Three levels: `error` where a run would not make sense, `warning` where the result would suffer, `note` for what is only worth knowing.
"""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from slamcli.config.options import RecordingConfig
from slamcli.console import Progress
from slamcli.datasets import Dataset, depth_unit, open_dataset, silent
from slamcli.datasets.depth_unit import DepthUnit
from slamcli.datasets.recording import spread
from slamcli.errors import SlamError
from slamcli.inspection import pictures, registration, rigidity, timing
from slamcli.inspection.findings import (
    ERROR,
    NOTE,
    WARNING,
    RecordingFinding,
    about_colour,
    about_depth,
    about_files,
    about_focal_length,
    about_lists,
    about_order,
    about_registration,
    about_streams,
    about_unit,
    is_textured,
)
from slamcli.inspection.pictures import Pictures
from slamcli.inspection.registration import RegistrationFinding
from slamcli.inspection.timing import StampTiming
from slamcli.slam import doubt

__all__ = ["ERROR", "NOTE", "WARNING", "Inspection", "RecordingFinding", "doubts", "inspect", "quick_look"]

QUICK_FRAMES, QUICK_BLOCKS = 30, 3  # looked at before a run: a second or two
VERDICTS = {ERROR: "do not run it like this", WARNING: "usable, with the faults listed", NOTE: "good"}


@dataclass(frozen=True)
class Inspection:
    """Everything that was found."""

    recording: str
    findings: list[RecordingFinding]
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def level(self) -> str:
        """Return the gravest level found."""
        levels = {finding.level for finding in self.findings}
        return next((level for level in (ERROR, WARNING) if level in levels), NOTE)

    @property
    def verdict(self) -> str:
        """Sum up in a few words."""
        return VERDICTS[self.level]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {
            "recording": self.recording,
            "verdict": self.verdict,
            "would_run": self.level != ERROR,
            "findings": [asdict(finding) for finding in self.findings],
            "facts": self.facts,
        }


def inspect(
    target: str,
    *,
    data: str | None = None,
    camera: dict[str, Any] | None = None,
    options: RecordingConfig | None = None,
    workers: int = 2,
    progress: Progress = silent,
) -> Inspection:
    """Inspect a recording: every image is read once."""
    try:
        dataset = open_dataset(target, data=data, camera=camera, options=options, progress=progress)
    except SlamError as error:
        return Inspection(target, [RecordingFinding(ERROR, "opening", str(error))])
    times = timing.judge(dataset)
    seen = pictures.look(dataset, workers=workers, progress=progress)
    unit = depth_unit.judge(seen.depth_counts, depth_unit.counting_scale(dataset.camera.depth_scale))
    fit, rigid = registration.measure(dataset, workers=workers), rigidity.measure(dataset)
    findings = [
        *about_lists(dataset, times),
        *about_order(dataset, times, seen),
        *about_files(dataset, seen),
        *about_colour(seen),
        *about_depth(dataset, times, seen),
        *about_streams(dataset, seen),
        *about_unit(dataset, unit),
        *about_focal_length(dataset, rigid),
        *about_registration(dataset, fit, times, is_textured=is_textured(seen)),
    ]
    return Inspection(str(dataset.root), findings, _facts(dataset, times, seen, unit, fit))


def quick_look(dataset: Dataset, *, workers: int = 2) -> list[RecordingFinding]:
    """Look at some frames spread over a recording and list what would spoil a run; what its opening said is not repeated."""
    frames = spread(len(dataset), QUICK_FRAMES)
    seen = pictures.look(dataset, workers=workers, progress=silent, frames=frames)
    times = timing.judge(dataset)
    findings = [
        *about_files(dataset, seen),
        *about_colour(seen),
        *about_depth(dataset, times, seen),
        *_about_registration(dataset, times, is_textured=is_textured(seen), workers=workers),
    ]
    return [finding for finding in findings if finding.level != NOTE]


def _about_registration(dataset: Dataset, times: StampTiming, *, is_textured: bool, workers: int) -> list[RecordingFinding]:
    """Judge by a few stretches whether depth lies on colour; what they find, or are too few for, more of them must confirm."""
    for blocks in (QUICK_BLOCKS, registration.BLOCKS):
        fit = registration.measure(dataset, workers=workers, blocks=blocks)
        found = about_registration(dataset, fit, times, is_textured=is_textured)
        if not found and fit.n_points >= registration.LEAST_POINTS:
            break
    return found


def doubts(findings: list[RecordingFinding]) -> list[doubt.Finding]:
    """Pick the finding on a recording that puts what is made of it in doubt as a whole, as a run keeps it: depth off colour, else late."""
    for check, name in (("registration", "registration"), ("time offset", "depth_delay")):
        found = [one for one in findings if one.check == check and one.level != NOTE]
        if found:
            return [doubt.Finding(name, f"{one.message}: {one.advice}", is_grave=True) for one in found]
    return []


def _facts(dataset: Dataset, times: StampTiming, seen: Pictures, unit: DepthUnit, fit: RegistrationFinding) -> dict[str, Any]:
    camera = dataset.camera
    return {
        "format": dataset.reader,
        "size": [camera.width, camera.height],
        "frames": len(dataset),
        "frames_with_depth": times.n_with_depth,
        "duration_s": round(times.duration, 3),
        "rate_hz": round(times.rate, 2),
        "gaps_s": [[round(a, 3), round(b, 3)] for a, b in times.gaps],
        "has_ground_truth": _has_ground_truth(dataset),
        "offset_median_s": _finite(times.offset_median, 5),
        "offset_p95_s": _finite(times.offset_p95, 5),
        "offset_histogram": [[round(a, 4), round(b, 4), n] for a, b, n in times.offset_histogram],
        "depth_scale": camera.depth_scale,
        "depth_m": {key: round(value, 3) for key, value in unit.percentiles.items()},
        "depth_q": _finite(unit.q, 1),
        "depth_steps_of": unit.camera or None,
        "likely_depth_scale": unit.likely_scale,
        "holes": _median(seen.holes),
        "never_seen": round(seen.never_seen, 4),
        "depth_shift_px": list(fit.shift) if fit.shift is not None else None,
        "depth_magnification": _finite(fit.magnification, 3),
        "depth_lag_s": _finite(fit.lag, 4),
        "blur": _median(seen.blur),
        "saturated": _median(seen.saturated),
        "mean_grey": _median(seen.mean_grey),
        "corners": _median(seen.corners),
        "unreadable_images": len(seen.errors),
    }


def _has_ground_truth(dataset: Dataset) -> bool:
    try:
        return dataset.ground_truth() is not None
    except SlamError:
        return False


def _finite(value: float | None, digits: int) -> float | None:
    return round(float(value), digits) if value is not None and np.isfinite(value) else None


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return round(float(np.median(known)), 4) if len(known) else None
