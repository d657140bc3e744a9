"""Remarks: what a reader of the page should know before trusting the result, a sentence each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.evaluation.run_content import Content
from slamcli.runs.staleness import MISSING
from slamcli.schema import ON_DEPTH, RELOCALIZED, TRACKED
from slamcli.slam import doubt
from slamcli.slam.doubt import Finding

GOOD, NOTE, BAD = "good", "note", "bad"
FEW_FEATURES = 150  # in a frame
FEW_INLIERS = 30  # landmarks that a frame's pose rests on
MANY = 0.05  # share of the frames
SCALE_OFF = 0.02
MOST_STAGE_WARNINGS = 5  # shown of each stage
MOST_SPANS = 5  # of lost frames


@dataclass(frozen=True)
class Remark:
    """One remark: is it good, worth knowing, or bad."""

    kind: str
    text: str


def collect(content: Content, inspected: Sequence[tuple[str, str]] = ()) -> list[Remark]:
    """Judge a run; the gravest first.

    inspected : level ("error", "warning" or "note") and text of each finding on the recording itself
    """
    found = [
        *_findings(content),
        *_map(content),
        *_poses(content),
        *_features(content),
        *_loops(content),
        *_scale(content),
        *_floor(content),
        *_stages(content),
        *(Remark(NOTE, f"Recording: {text}") for text in content.recording_warnings if not inspected),
        *(Remark(BAD if level == "error" else NOTE, f"Recording: {text}") for level, text in inspected),
    ]
    return sorted(found, key=lambda remark: (BAD, NOTE, GOOD).index(remark.kind))


def _findings(content: Content) -> list[Remark]:
    texts = [(one.is_grave, one.text.replace(doubt.SEE_REPORT, ", amber in the charts below")) for one in _doubts(content)]
    return [Remark(BAD if is_grave else NOTE, f"{text[:1].upper()}{text[1:]}.") for is_grave, text in texts]


def _doubts(content: Content) -> list[Finding]:
    return doubt.from_records({stage: state.record for stage, state in content.states.items()})


def _map(content: Content) -> list[Remark]:
    verdict = content.verdict
    if verdict is None:
        return []
    findings = [Remark(NOTE, f"{'A robot could not use this map' if f.is_grave else 'Map'}: {f}.") for f in verdict.findings]
    return [*findings, *([Remark(GOOD, f"A robot can use the map: {verdict.summary}.")] if verdict.is_usable else [])]


def _poses(content: Content) -> list[Remark]:
    n, lost, apart = len(content.stamp), content.n_lost, content.n_apart
    if apart:
        text = f"{apart} of {n} frames belong to map segments that could not be joined to the main one; no map shows what they saw."
        return [Remark(BAD if apart > MANY * n else NOTE, text), *(_lost(content) if lost else [])]
    return _lost(content) if lost else [Remark(GOOD, f"All {n} frames have a pose.")]


def _lost(content: Content) -> list[Remark]:
    n, lost = len(content.stamp), content.n_lost
    spans = content.summary("track").get("lost_spans") or []
    where = "; ".join(
        f"{first} to {last}: {reason}" if last > first else f"{first}: {reason}" for first, last, reason in spans[:MOST_SPANS]
    )
    more = f"; and {len(spans) - MOST_SPANS} more stretches" if len(spans) > MOST_SPANS else ""
    return [
        Remark(
            BAD if lost > MANY * n else NOTE,
            f"{lost} of {n} frames are lost and have no pose. {where and 'Frames ' + where + more + '.'}".strip(),
        )
    ]


def _features(content: Content) -> list[Remark]:
    found = []
    n = len(content.stamp)
    few = int((content.n_features < FEW_FEATURES).sum())
    if few > MANY * n:
        found.append(Remark(BAD, f"{few} of {n} frames have fewer than {FEW_FEATURES} features: too dark, blurred, or bare walls."))
    on_depth = int((content.state == ON_DEPTH).sum())
    if on_depth:
        found.append(Remark(NOTE, f"{on_depth} frames were placed by the shape that depth shows, as their pictures show too little."))
    weak = int(((content.n_inliers < FEW_INLIERS) & np.isin(content.state, (TRACKED, RELOCALIZED))).sum())
    if weak > MANY * n:
        found.append(Remark(NOTE, f"The poses of {weak} frames rest on fewer than {FEW_INLIERS} landmarks and may be inaccurate."))
    without = content.summary("extract").get("frames_without_depth", 0)
    if without > MANY * n:
        found.append(Remark(NOTE, f"{without} of {n} colour frames have no depth image near enough in time."))
    return found


def _loops(content: Content) -> list[Remark]:
    if content.stage != "loop":
        return [Remark(NOTE, f"Loop closing has not been run: this is the trajectory of {content.stage}.")]
    if len(content.loops):
        return [Remark(GOOD, "One loop was closed." if len(content.loops) == 1 else f"{len(content.loops)} loops were closed.")]
    return [Remark(NOTE, "No loop was closed. If the camera came back to a place it had seen, the map may show it twice.")]


def _scale(content: Content) -> list[Remark]:
    ape = content.ape.get(content.stage)
    if ape is None or abs(ape.scale - 1.0) <= SCALE_OFF:
        return []
    scale = content.recording["camera"]["depth_scale"]
    fits = f"The trajectory fits the truth best when scaled by {100 * (ape.scale - 1.0):+.1f} %"
    return [Remark(BAD, f"{fits}: is the depth scale right? It is {scale:g}, {scale / ape.scale:.0f} would fit.")]


def _floor(content: Content) -> list[Remark]:
    if content.ground is None:
        return []
    if not content.ground.is_found:
        return [Remark(BAD, "No floor was found. Heights are measured from the first camera, so the grid is not fit to drive on.")]
    rms = 1000 * float(content.ground.inlier_rms)
    return [Remark(GOOD, f"The floor was found; its points lie within {rms:.0f} mm (RMS) of a plane.")]


def _stages(content: Content) -> list[Remark]:
    found, unfit, gone = [], [], list[str]()
    for stage, state in content.states.items():
        if stage in content.cleaned:
            gone += [stage] * (state.state == MISSING)
        elif state.state == MISSING:
            found.append(Remark(NOTE, f"{stage} has not been run; go on with: {content.update}"))
        elif not state.is_fresh:
            unfit.append(state)
        warnings = [
            text
            for text in state.record.get("warnings", [])
            if "are lost:" not in text and "is lost:" not in text and "no floor" not in text
        ]
        found += [Remark(NOTE, f"{stage}: {text}") for text in warnings[:MOST_STAGE_WARNINGS]]
        if len(warnings) > MOST_STAGE_WARNINGS:
            total = state.record.get("n_warnings", len(warnings))
            found.append(Remark(NOTE, f"{stage}: {total} warnings in all; they are in log.txt"))
    if gone:
        told = f"{', '.join(gone)} {'was' if len(gone) == 1 else 'were'} cleaned away"
        found.append(Remark(NOTE, f"{told}: what rests on them is left out here; all is made anew with: {content.update}"))
    if unfit:
        told = f"{unfit[0].stage} is {unfit[0].state} ({unfit[0].reason})"
        rest = f", and so {'is' if len(unfit) == 2 else 'are'} {', '.join(state.stage for state in unfit[1:])}" if len(unfit) > 1 else ""
        found.append(Remark(BAD, f"{told}{rest}; bring up to date with: {content.update}"))
    return found


def headline(content: Content) -> str:
    """Sum up in one line, and before that what puts the whole in doubt."""
    said = doubt.headline(_doubts(content))
    return f"{said}. {_located(content)}" if said else _located(content)


def _located(content: Content) -> str:
    n, n_poses = len(content.stamp), int(content.has_pose.sum())
    length = float(np.nansum(np.linalg.norm(np.diff(content.path, axis=0), axis=1)))
    text = f"{n_poses} of {n} frames located along {length:.1f} m in {content.seconds:.1f} s"
    ape = content.ape.get(content.stage)
    return f"{text}; {1000 * ape.rmse:.1f} mm from the truth (RMS)" if ape else text
