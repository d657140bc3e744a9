"""Judgements of a recording: what was found, how grave it is, what to do about it."""

from dataclasses import dataclass

import numpy as np

from slamcli.calibration.plausibility import Rigidity
from slamcli.datasets import Dataset
from slamcli.datasets.depth_unit import DepthUnit
from slamcli.hints import hint
from slamcli.inspection import pictures, timing
from slamcli.inspection.pictures import Pictures
from slamcli.inspection.registration import RegistrationFinding
from slamcli.inspection.timing import StampTiming
from slamcli.slam import calibration_doubt, stream_doubt

ERROR, WARNING, NOTE = "error", "warning", "note"
REDUCED = " px are used at "  # of the reader's message that large pictures were made smaller, as is usual

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
MANY_EDGES = 8000  # depth edges that must meet some of colour's, in a picture with texture
TEXTURED = 100.0  # FAST corners per 640 x 480 px of such a picture
DESCRIBE = "describe the depth camera in a table [depth] of camera.toml: fx fy cx cy and its place"
EXPECTED_LAG = (-0.02, 0.035)  # [s]; the stamps of the first Kinect's depth are about 0.02 s late


@dataclass(frozen=True)
class RecordingFinding:
    """One thing found, in a sentence for the user, and what to do about it."""

    level: str
    check: str
    message: str
    advice: str = ""


def about_lists(dataset: Dataset, times: StampTiming) -> list[RecordingFinding]:
    """Judge what opening the recording put right, gaps, and frames without a partner."""
    findings = [
        RecordingFinding(NOTE, "size", message)
        if REDUCED in message
        else RecordingFinding(WARNING, "lists", message, "" if "assumed" in message else "put right on reading")
        for message in dataset.warnings
        if "depth_scale" not in message and "hold no reading" not in message
    ]
    for what, gaps in (("colour", times.gaps), ("depth", times.depth_gaps)):
        if gaps:
            start, length = max(gaps, key=lambda gap: gap[1])
            count = f"{len(gaps)} gaps" if len(gaps) > 1 else "a gap"
            findings.append(
                RecordingFinding(
                    WARNING,
                    "gaps",
                    f"{count} in {what}, the longest of {length:.2f} s, {start:.2f} s after the start",
                    "tracking may be lost there; record to a faster disk, or cut the recording in two",
                )
            )
    n, n_with_depth = len(dataset), times.n_with_depth
    if n - n_with_depth > UNMATCHED * n:
        findings.append(
            RecordingFinding(
                WARNING,
                "unmatched",
                f"{n - n_with_depth} of {n} colour frames have no depth image within {timing.MAX_DIFFERENCE:g} s",
                "compare the rates and the clocks of both cameras",
            )
        )
    if n < 30:
        findings.append(RecordingFinding(NOTE, "length", f"only {n} frames", "a map of this little will be small"))
    return findings


def about_order(dataset: Dataset, times: StampTiming, seen: Pictures) -> list[RecordingFinding]:
    """Judge whether images follow one another as their stamps say."""
    findings = []
    if times.misnamed:
        first = times.misnamed[0]
        findings.append(
            RecordingFinding(
                WARNING,
                "order",
                f"{len(times.misnamed)} frames have other stamps than their files' names say, the first is {dataset.colour_name[first]}",
                "stamps were swapped or edited; restore those that were recorded",
            )
        )
    has_depth = np.array([bool(path) for path in dataset.depth_name])
    rows = np.flatnonzero(has_depth)
    for what, paths, found in (
        ("colour", dataset.colour_name, pictures.misplaced(_lit(seen), dataset.stamp)),
        ("depth", dataset.depth_name, rows[pictures.misplaced(seen.depth_thumbnail[rows], dataset.depth_stamp[rows])]),
    ):
        if len(found):
            findings.append(
                RecordingFinding(
                    WARNING,
                    "order",
                    f"{len(found)} {what} images do not follow from those before and after, the first is {paths[found[0]]}",
                    "their stamps may be swapped, or images of another recording got in",
                )
            )
    return findings


def _lit(seen: Pictures) -> np.ndarray:
    """Return the thumbnails of colour, NaN where the picture is nearly black: a covered lens says nothing of order."""
    return np.where((seen.mean_grey < TOO_DARK)[:, None, None], np.float32(np.nan), seen.thumbnail)


def about_files(dataset: Dataset, seen: Pictures) -> list[RecordingFinding]:
    """Judge images that cannot be used."""
    if not seen.errors:
        return []
    n_frames, n_without_colour = len(seen.mean_grey), int(np.isnan(seen.mean_grey).sum())
    worst = max(n_without_colour, len(seen.errors) - n_without_colour)  # colour, depth
    level = ERROR if worst > MANY_FRAMES * n_frames else WARNING
    more = f" and {len(seen.errors) - 1} more" if len(seen.errors) > 1 else ""
    return [RecordingFinding(level, "files", f"{seen.errors[0]}{more}", "such frames are skipped; copy or unpack the recording again")]


def about_colour(seen: Pictures) -> list[RecordingFinding]:
    """Judge blur, exposure and texture of the pictures."""
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
            findings.append(RecordingFinding(level, check, f"{n} of {known} colour images are {message}", advice))
    return findings


def about_depth(dataset: Dataset, times: StampTiming, seen: Pictures) -> list[RecordingFinding]:
    """Judge holes and empty images of depth."""
    holes = seen.holes[np.isfinite(seen.holes)]
    is_empty = holes > EMPTY
    if not len(holes) or is_empty.all():
        return [
            RecordingFinding(ERROR, "empty depth", "no depth image holds a reading", "check how depth was recorded; 16-bit PNG, 0 = none")
        ]
    findings = []
    if is_empty.sum() > FEW_FRAMES * len(holes):
        level = ERROR if is_empty.mean() > MANY_FRAMES else WARNING
        message = f"{int(is_empty.sum())} of {len(holes)} depth images are empty"
        findings.append(RecordingFinding(level, "empty depth", message, "something covered the camera, or the depth stream broke off"))
    typical = float(np.median(holes[~is_empty]))
    if typical > HOLES:
        message = f"a typical depth image has no reading in {typical:.0%} of its pixels"
        findings.append(RecordingFinding(WARNING, "holes", message, "too near, too far, glass, sunlight, or an image cut in half"))
    elif seen.never_seen > NEVER_SEEN:
        message = f"{seen.never_seen:.0%} of the picture have no depth in any frame"
        findings.append(RecordingFinding(WARNING, "holes", message, "depth may be registered to another camera or cut off"))
    return findings


def about_streams(dataset: Dataset, seen: Pictures) -> list[RecordingFinding]:
    """Judge whether the images of all frames are what a camera sees: streams that stand still, depth without sense."""
    same = (np.append(False, (taken[1:] == taken[:-1]) & (taken[1:] >= 0)) for taken in (seen.picture_sum, seen.depth_sum))
    found = stream_doubt.about_motion(dataset.stamp, *same)
    if any(one is not None and one.share > 0 for one in seen.readings):  # else `about_depth` says so
        found += stream_doubt.about_readings(list(seen.readings))
    return [RecordingFinding(ERROR if one.is_grave else WARNING, one.name.replace("_", " "), *one.text.split(": ", 1)) for one in found]


def is_textured(seen: Pictures) -> bool:
    """Say whether a typical picture has enough corners for its edges to be told."""
    known = seen.corners[np.isfinite(seen.corners)]
    return bool(len(known) and np.median(known) >= TEXTURED)


def about_unit(dataset: Dataset, unit: DepthUnit) -> list[RecordingFinding]:
    """Judge the depth scale."""
    if unit.likely_scale is None:
        return []
    message = f"the depth scale {dataset.camera.depth_scale:g} is doubtful: {unit.reason}"
    level = WARNING if unit.q is not None and not unit.camera else ERROR  # a camera may be new
    return [RecordingFinding(level, "depth scale", message, f"try: {hint().setting('camera.depth_scale', unit.likely_scale)}")]


def about_focal_length(dataset: Dataset, rigid: Rigidity | None) -> list[RecordingFinding]:
    """Judge the focal length."""
    return [RecordingFinding(ERROR, "focal length", *one.text.split(": ", 1)) for one in calibration_doubt.about({}, rigid, dataset.camera)]


def about_registration(dataset: Dataset, fit: RegistrationFinding, times: StampTiming, *, is_textured: bool) -> list[RecordingFinding]:
    """Judge whether depth lies on colour, in place and in time."""
    findings = []
    camera = dataset.camera
    if fit.magnification is not None:
        message = f"depth does not lie on colour: its edges fit when it is enlarged {fit.magnification:.2f} times"
        advice = f"it seems to be in the pixels of a depth camera of focal length {camera.fx / fit.magnification:.0f} px: {DESCRIBE}"
        findings.append(RecordingFinding(WARNING, "registration", message, advice))
    elif fit.shift is None and fit.n_points >= MANY_EDGES and is_textured:
        message = "the edges of depth meet those of colour nowhere: depth may not be registered, and the map's scale is then in doubt"
        findings.append(RecordingFinding(WARNING, "registration", message, f"record depth registered to colour, or {DESCRIBE}"))
    elif fit.shift is not None and max(map(abs, fit.shift)) > max(SHIFT * dataset.camera.width, 2.0):
        message = f"depth does not lie on colour: its edges fit when moved by ({fit.shift[0]:+.0f}, {fit.shift[1]:+.0f}) px"
        findings.append(
            RecordingFinding(WARNING, "registration", message, "register depth to the colour camera, with that camera's calibration")
        )
    if fit.lag is not None and not EXPECTED_LAG[0] <= fit.lag <= EXPECTED_LAG[1]:
        late = "late" if fit.lag > 0 else "early"
        message = f"depth stamps are {abs(fit.lag):.3f} s {late}: the edges of depth and colour meet only then"
        findings.append(RecordingFinding(WARNING, "time offset", message, f"add {-fit.lag:+.3f} s to the stamps of depth"))
    elif fit.lag is None and times.depth_names_offset is not None and abs(times.depth_names_offset) > 0.02:
        message = f"the depth stamps differ from their files' names by {times.depth_names_offset:+.3f} s"
        findings.append(
            RecordingFinding(WARNING, "stamps", message, "the clock of depth was moved; restore its stamps unless that was meant")
        )
    return findings
