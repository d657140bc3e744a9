"""What is wrong with a recording, before time is spent on it.

Three levels: `error` where a run would not make sense, `warning` where the result would suffer, `note` for what is only worth knowing.
"""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from slamcli.config.options import RecordingConfig
from slamcli.datasets import Dataset, depth_unit, open_dataset, silent
from slamcli.datasets.depth_unit import DepthUnit
from slamcli.errors import SlamError
from slamcli.inspection import pictures, registration, timing
from slamcli.inspection.pictures import Pictures
from slamcli.inspection.registration import Registration
from slamcli.inspection.timing import Timing

__all__ = ["ERROR", "NOTE", "WARNING", "Finding", "Inspection", "inspect"]

ERROR, WARNING, NOTE = "error", "warning", "note"
VERDICTS = {ERROR: "do not run it like this", WARNING: "usable, with the faults listed", NOTE: "good"}

# Thresholds lie between what sound recordings show and what the fault shows; the sound ones measured are TUM fr1_xyz and fr3_teddy.
BLURRED = 0.60  # blur effect; sound recordings reach 0.58 in their fastest moments, a Gaussian of 2 px starts at 0.60
BURNT_OUT = 0.35  # share of saturated pixels; sound ones reach 0.24 (windows)
TOO_BRIGHT, TOO_DARK = 215.0, 25.0  # mean grey levels
FEW_CORNERS = 25.0  # FAST corners per 640 x 480 px
FEW_FRAMES = 0.02  # share of frames that may be so without a word
MANY_FRAMES = 0.5  # share from which a run makes no sense
HOLES = 0.5  # share of the pixels without depth in a typical frame; sound ones have 0.17 to 0.31
NEVER_SEEN = 0.35  # share of the pixels without depth in all frames; sound ones have 0.11 to 0.15
EMPTY = 0.98  # share of holes from which a depth image counts as empty
UNMATCHED = 0.15  # share of colour frames without depth; sound ones have 0.01 to 0.04
SHIFT = 4.0 / 640  # of the picture's width; sound ones are within 1 px of 640
EXPECTED_LAG = (-0.02, 0.035)  # [s]; the stamps of the first Kinect's depth are about 0.02 s late

Progress = Callable[..., Iterable]


@dataclass(frozen=True)
class Finding:
    """One thing found, in plain words, and what to do about it."""

    level: str
    check: str
    message: str
    advice: str = ""


@dataclass(frozen=True)
class Inspection:
    """Everything that was found."""

    recording: str
    findings: list[Finding]
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def level(self) -> str:
        """Give the gravest level found."""
        levels = {finding.level for finding in self.findings}
        return next((level for level in (ERROR, WARNING) if level in levels), NOTE)

    @property
    def verdict(self) -> str:
        """Sum up in a few words."""
        return VERDICTS[self.level]

    def to_dict(self) -> dict[str, Any]:
        """Give everything as plain values."""
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
        return Inspection(target, [Finding(ERROR, "opening", str(error))])
    times = timing.judge(dataset)
    seen = pictures.look(dataset, workers=workers, progress=progress)
    unit = depth_unit.judge(seen.depth_counts, pictures.counting_scale(dataset.camera))
    fit = registration.measure(dataset, workers=workers)
    findings = [
        *_about_lists(dataset, times),
        *_about_order(dataset, times, seen),
        *_about_files(dataset, seen),
        *_about_colour(seen),
        *_about_depth(dataset, times, seen),
        *_about_unit(dataset, unit),
        *_about_registration(dataset, fit, times),
    ]
    return Inspection(str(dataset.root), findings, _facts(dataset, times, seen, unit, fit))


def _about_lists(dataset: Dataset, times: Timing) -> list[Finding]:
    findings = [Finding(WARNING, "lists", message, "the program puts this right; mend the list to be rid of the warning")
                for message in dataset.warnings if "depth_scale" not in message and "hold no reading" not in message]  # fmt: skip
    for what, gaps in (("colour", times.gaps), ("depth", times.depth_gaps)):
        if gaps:
            start, length = max(gaps, key=lambda gap: gap[1])
            count = f"{len(gaps)} gaps" if len(gaps) > 1 else "a gap"
            findings.append(
                Finding(
                    WARNING,
                    "gaps",
                    f"{count} in {what}, the longest of {length:.2f} s, {start:.2f} s after the start",
                    "tracking may be lost there; record to a faster disk, or cut the recording in two",
                )
            )
    n, n_with_depth = len(dataset), times.n_with_depth
    if n - n_with_depth > UNMATCHED * n:
        findings.append(
            Finding(
                WARNING,
                "unmatched",
                f"{n - n_with_depth} of {n} colour frames have no depth image within {timing.MAX_DIFFERENCE:g} s",
                "compare the rates and the clocks of both lists",
            )
        )
    if n < 30:
        findings.append(Finding(NOTE, "length", f"only {n} frames", "a map of this little will be small"))
    return findings


def _about_order(dataset: Dataset, times: Timing, seen: Pictures) -> list[Finding]:
    findings = []
    if times.misnamed:
        first = times.misnamed[0]
        findings.append(
            Finding(
                WARNING,
                "order",
                f"{len(times.misnamed)} frames have other stamps than their files' names say, the first is {dataset.colour_name[first]}",
                "the stamps in the list are swapped or edited; restore the list",
            )
        )
    has_depth = np.array([bool(path) for path in dataset.depth_name])
    rows = np.flatnonzero(has_depth)
    for what, paths, found in (
        ("colour", dataset.colour_name, pictures.misplaced(seen.thumbnail, dataset.stamp)),
        ("depth", dataset.depth_name, rows[pictures.misplaced(seen.depth_thumbnail[rows], dataset.depth_stamp[rows])]),
    ):
        if len(found):
            findings.append(
                Finding(
                    WARNING,
                    "order",
                    f"{len(found)} {what} images do not follow from those before and after, the first is {paths[found[0]]}",
                    "their stamps may be swapped, or images of another recording got in",
                )
            )
    return findings


def _about_files(dataset: Dataset, seen: Pictures) -> list[Finding]:
    if not seen.errors:
        return []
    n_images = len(dataset) + sum(map(bool, dataset.depth_name))
    level = ERROR if len(seen.errors) > MANY_FRAMES * n_images else WARNING
    more = f" and {len(seen.errors) - 1} more" if len(seen.errors) > 1 else ""
    return [Finding(level, "files", f"{seen.errors[0]}{more}", "such frames are skipped; copy or unpack the recording again")]


def _about_colour(seen: Pictures) -> list[Finding]:
    findings = []
    burnt = (seen.saturated > BURNT_OUT) | (seen.mean_grey > TOO_BRIGHT)
    dark = seen.mean_grey < TOO_DARK
    blurred = (seen.blur > BLURRED) & ~burnt & ~dark
    bare = (seen.corners < FEW_CORNERS) & ~burnt & ~dark & ~blurred
    for check, is_so, message, advice in (
        ("blur", blurred, "blurred", "move slower, or shorten the exposure"),
        ("exposure", burnt, "over-exposed", "lower exposure or gain; what is burnt out has no features"),
        ("exposure", dark, "nearly black", "raise exposure or gain, or switch the light on"),
        (
            "texture",
            bare,
            f"almost without texture (fewer than {FEW_CORNERS:g} corners)",
            "tracking may be lost there; keep furniture in view",
        ),
    ):
        n, known = int(is_so.sum()), int(np.isfinite(seen.mean_grey).sum())
        limit = 0.1 if check == "texture" else FEW_FRAMES
        if n > limit * known:
            level = ERROR if n > MANY_FRAMES * known else WARNING
            findings.append(Finding(level, check, f"{n} of {known} colour images are {message}", advice))
    return findings


def _about_depth(dataset: Dataset, times: Timing, seen: Pictures) -> list[Finding]:
    holes = seen.holes[np.isfinite(seen.holes)]
    is_empty = holes > EMPTY
    if not len(holes) or is_empty.all():
        return [Finding(ERROR, "empty depth", "no depth image holds a reading", "check how depth was recorded; 16-bit PNG, 0 = none")]
    findings = []
    if is_empty.sum() > FEW_FRAMES * len(holes):
        level = ERROR if is_empty.mean() > MANY_FRAMES else WARNING
        message = f"{int(is_empty.sum())} of {len(holes)} depth images are empty"
        findings.append(Finding(level, "empty depth", message, "something covered the camera, or the depth stream broke off"))
    typical = float(np.median(holes[~is_empty]))
    if typical > HOLES:
        message = f"a typical depth image has no reading in {typical:.0%} of its pixels"
        findings.append(Finding(WARNING, "holes", message, "too near, too far, glass, sunlight, or an image cut in half"))
    elif seen.never_seen > NEVER_SEEN:
        message = f"{seen.never_seen:.0%} of the picture have no depth in any frame"
        findings.append(Finding(WARNING, "holes", message, "depth may be registered to another camera or cut off"))
    return findings


def _about_unit(dataset: Dataset, unit: DepthUnit) -> list[Finding]:
    if unit.likely_scale is None:
        return []
    message = f"the depth scale {dataset.camera.depth_scale:g} is doubtful: {unit.reason}"
    return [Finding(ERROR, "depth scale", message, f"try: -s camera.depth_scale={unit.likely_scale:g}")]


def _about_registration(dataset: Dataset, fit: Registration, times: Timing) -> list[Finding]:
    findings = []
    if fit.shift is not None and max(map(abs, fit.shift)) > max(SHIFT * dataset.camera.width, 2.0):
        message = f"depth does not lie on colour: its edges fit when moved by ({fit.shift[0]:+.0f}, {fit.shift[1]:+.0f}) px"
        findings.append(Finding(WARNING, "registration", message, "register depth to the colour camera, with that camera's calibration"))
    if fit.lag is not None and not EXPECTED_LAG[0] <= fit.lag <= EXPECTED_LAG[1]:
        late = "late" if fit.lag > 0 else "early"
        message = f"depth stamps are {abs(fit.lag):.3f} s {late}: the edges of depth and colour meet only then"
        findings.append(Finding(WARNING, "time offset", message, f"add {-fit.lag:+.3f} s to the stamps in the depth list"))
    elif fit.lag is None and times.depth_names_offset is not None and abs(times.depth_names_offset) > 0.02:
        message = f"the depth stamps differ from their files' names by {times.depth_names_offset:+.3f} s"
        findings.append(Finding(WARNING, "time offset", message, "the clock of depth was moved; restore the list unless that was meant"))
    return findings


def _facts(dataset: Dataset, times: Timing, seen: Pictures, unit: DepthUnit, fit: Registration) -> dict[str, Any]:
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
