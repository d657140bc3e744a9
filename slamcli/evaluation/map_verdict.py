"""Whether a robot could use a run's map, why not, and what to do about it at the next recording."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from slamcli.depth import icp
from slamcli.evaluation import map_evidence
from slamcli.evaluation.map_evidence import FrameSurface, MapEvidence
from slamcli.runs.run_directory import RunDir
from slamcli.schema import Grid, Ground, Map, Moving, Tracks, frame_poses
from slamcli.stages.depth_frames import depth_poses
from slamcli.stages.moving_parts import still

# A map with less free floor than this, or than the camera's path covers, or with fewer such views is of no use; the others tell why.
LEAST_FREE = 2.0  # [m^2] of free floor: a robot of 0.2 m radius can hardly turn round on less
LEAST_FLOOR = 0.4  # share of the views that saw the floor
LEAST_PATH = 0.25  # share of the camera's path over known cells; drives have 0.8 and more, a hand that circles something has 0
MOST_DOUBLED = 0.04  # share of the views in whose free space another view puts what they see; sound recordings have 0
MOST_MISSING = 0.4  # share of the depth images' pixels; sound recordings have 0.04 to 0.31
MOST_WALL = 0.4  # share of the views that show one flat wall alone
HIGH_CAMERA = 1.3  # [m] a level camera above this sees no floor within reach
AIM = 0.75  # of the grid's range: where the middle of the picture should meet the floor

NO_FLOOR, RARE_FLOOR, TOO_HIGH = "floor never seen", "floor rarely seen", "camera too high"
HOLES, WALL, DOUBLED, SMALL, OFF_PATH = "depth holes", "flat wall", "map doubled", "little floor", "path unknown"
DOWN = "tilt the camera down until the floor 1 to 2 m ahead is in the picture"


@dataclass(frozen=True)
class MapFinding:
    """One thing that speaks against a map, with its remedy."""

    cause: str
    message: str
    remedy: str
    is_grave: bool = True  # a robot could not use the map; else it only has to know

    def __str__(self) -> str:
        return f"{self.message}: {self.remedy}"


@dataclass(frozen=True)
class Verdict:
    """What was measured of a map, and the reasons against it, the most telling first."""

    evidence: MapEvidence
    findings: tuple[MapFinding, ...]

    @property
    def is_usable(self) -> bool:
        """Tell whether nothing grave speaks against giving the map to a robot."""
        return not any(finding.is_grave for finding in self.findings)

    @property
    def summary(self) -> str:
        """Return the figures in one line."""
        e = self.evidence
        return f"{e.free_area:.1f} m2 of free floor; {e.path_known:.0%} of the path known; floor seen in {e.views_with_floor} of {e.views} views"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values; what could not be measured is null."""
        figures = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in asdict(self.evidence).items()
        }
        rounded = {name: round(value, 4) if isinstance(value, float) else value for name, value in figures.items()}
        return {"is_usable": self.is_usable, **rounded, "findings": [asdict(finding) for finding in self.findings]}


def judge(evidence: MapEvidence, *, max_range: float) -> Verdict:
    """Judge a map by what was measured of it.

    max_range : [m] to which the grid uses depth
    """
    is_small = evidence.free_area < max(LEAST_FREE, evidence.path_area)
    is_poor = is_small or evidence.views_with_floor < LEAST_FLOOR * evidence.views or not evidence.is_floor_found
    # A map is unusable when it is poor, whatever the causes named for it, or doubled; all else is worth a word only.
    if is_poor:
        why = [*_wall(evidence), *_holes(evidence), *_floor(evidence, max_range)] or [_small(evidence)]
    else:
        why = [replace(finding, is_grave=False) for finding in (*_holes(evidence), *_path(evidence))]
    return Verdict(evidence, (*_doubled(evidence), *why))


def _doubled(e: MapEvidence) -> list[MapFinding]:
    if e.views_doubled <= MOST_DOUBLED * e.views:
        return []
    message = f"surfaces lie twice in the map, {e.doubled_by:.2f} m apart, in {e.views_doubled} of {e.views} views"
    return [
        MapFinding(DOUBLED, message, "come back to where you began and look at it the same way for a while, so that the loop is closed")
    ]


def _wall(e: MapEvidence) -> list[MapFinding]:
    if e.views_of_a_wall <= MOST_WALL * e.views:
        return []
    message = f"a flat wall is all that {e.views_of_a_wall} of {e.views} views show"
    return [MapFinding(WALL, message, "walk so that a corner and the floor are in view")]


def _holes(e: MapEvidence) -> list[MapFinding]:
    if e.missing <= MOST_MISSING:
        return []
    message = f"depth has {e.missing:.0%} holes"
    return [MapFinding(HOLES, message, "keep 0.5 to 4 m away from what you record, and off glass, mirrors and sunlight")]


def _floor(e: MapEvidence, max_range: float) -> list[MapFinding]:
    seen = f"floor seen in {e.views_with_floor} of {e.views} views"
    if e.views_with_floor == 0 or not e.is_floor_found:
        high = e.is_floor_found and e.camera_height >= HIGH_CAMERA
        return [_too_high(e, seen, max_range) if high else MapFinding(NO_FLOOR, seen, DOWN)]
    if e.views_with_floor >= LEAST_FLOOR * e.views:
        return []
    return [_too_high(e, seen, max_range) if e.camera_height >= HIGH_CAMERA else MapFinding(RARE_FLOOR, seen, DOWN)]


def _too_high(e: MapEvidence, seen: str, max_range: float) -> MapFinding:
    tilt = math.degrees(math.asin(min(1.0, e.camera_height / (AIM * max_range))))
    high = f"the camera is {e.camera_height:.1f} m high and looks {e.camera_pitch_deg:.0f} degrees down: {seen} within {max_range:g} m"
    return MapFinding(TOO_HIGH, high, f"carry it lower, or tilt it down by some {tilt:.0f} degrees")


def _small(e: MapEvidence) -> MapFinding:
    camera = f"{e.camera_height:.1f} m high and looking {e.camera_pitch_deg:.0f} degrees down, it saw floor in {e.views_with_floor} of {e.views} views"
    message = f"only {e.free_area:.1f} m2 of free floor, and the camera passed over {e.path_area:.1f} m2: {camera}"
    return MapFinding(SMALL, message, "walk through the room with the floor ahead in view")


def _path(e: MapEvidence) -> list[MapFinding]:
    if e.path_known >= LEAST_PATH:
        return []
    message = f"{1 - e.path_known:.0%} of the camera's path lie in space never seen: a robot's path can only begin beside it"
    return [MapFinding(OFF_PATH, message, "look at the floor before you walk over it")]


def of_run(run: RunDir) -> Verdict | None:
    """Judge a run's map; None while there is none."""
    if any(run.record(stage) is None for stage in ("extract", "loop", "densify", "grid2d")):
        return None
    config, ground = run.config(), run.load(Ground, "densify")
    T_lc = ground.T_lw @ frame_poses(run.load(Tracks, "loop"), run.load(Map, "loop"))
    evidence = map_evidence.measure(
        run.load(Grid, "grid2d"), T_lc, _views(run, ground.T_lw), is_floor_found=bool(ground.is_found), max_range=config.grid2d.max_range
    )
    return judge(evidence, max_range=config.grid2d.max_range)


def _views(run: RunDir, T_lw: np.ndarray) -> list[FrameSurface]:
    """Read frames spread over the recording, of those that have a pose and depth, without what moves: it is seen in several places."""
    (_, images), sensor = still(run, run.load(Moving, "loop")), run.config().sensor
    camera, given = run.camera("loop"), run.camera()
    poses = [(frame, T_lw @ T_wd) for frame, T_wd in depth_poses(run, frames="all") if images[frame].any()]
    rows = sorted({int(row) for row in np.linspace(0, len(poses) - 1, min(len(poses), map_evidence.MOST_VIEWS))})
    return [
        FrameSurface(T_lc, icp.surface_points(images[frame], camera, sensor, given=given), float((images[frame] == 0).mean()))
        for frame, T_lc in (poses[row] for row in rows)
    ]
