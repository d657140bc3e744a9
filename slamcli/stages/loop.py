"""loop: places seen again are joined, the whole map is adjusted, and all frames meet it once more."""

import csv
import io
from pathlib import Path

import numpy as np

from slamcli import artifacts, files
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.formats.g2o import write_g2o
from slamcli.schema import LOST, Closures, DepthTimes, FrameTimes, Map, Moving, Recordings, Rests, Timing, Tracks, Words, frame_segments
from slamcli.slam import doubt, final_refinement, loop_pose_graph, map_segments, pose_doubt
from slamcli.slam.common_place import Jury
from slamcli.slam.depth_tracking import FramePoints
from slamcli.slam.final_refinement import DepthConstraints, Refinement
from slamcli.slam.loop_candidates import Candidate
from slamcli.slam.loop_closing import LoopCloser, Objections, no_objection
from slamcli.slam.moving_objects import FOR_MAPS
from slamcli.slam.recording import TrackedRecording
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import measurements, moving_parts, of_several
from slamcli.stages.camera_file import write_camera
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.map_outputs import describe_other_segments, save_map, segment_file

FEWEST_KEY_FRAMES = 2  # of a map in which no place can be seen again


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Join map segments and close loops until no new one appears; then look at all key frames and frames again."""
    tracks, when, camera = inputs.load(Tracks, "optimize"), inputs.load(Timing, "optimize"), inputs.camera("optimize")
    hidden = inputs.load(Moving, "track")
    features, depth = moving_parts.still(inputs, hidden)
    features = measurements.corrected(inputs, features, inputs.camera(), Sensing(camera, when, {}))
    frames = FrameStore(features, camera, cfg.sensor)
    sparse_map = SparseMap.from_map(features, inputs.load(Map, "optimize"))

    jury = Jury(sparse_map, depth, frames, cfg.loop)
    # Segments of one recording are of one place; those of several may not be, so that joining them is to be justified.
    to_join = jury.objection if when.is_of_several else no_objection
    tried = close_loops(inputs, sparse_map, frames, Objections(to_join, jury.objection_to_closure), cfg, tools)
    accepted = [c for c in tried if c.is_accepted]
    if accepted and cfg.loop.final_refinement:  # now that places seen again coincide
        points = FramePoints(depth, inputs.camera(), cfg.sensor)
        edges = DepthConstraints(points, when, most=cfg.loop.depth_icp_edges, weight=cfg.loop.depth_icp_weight)
        by, tracked = Refinement(cfg.track, edges, cfg.loop.iterations), TrackedRecording(frames, tracks, inputs.load(Rests, "track"))
        tracks, _ = final_refinement.refine_all(sparse_map, tracked, by, progress=tools.progress, workers=tools.workers)
    map_ = map_segments.from_first_frames(main_first(sparse_map.snapshot(), tracks, cfg.loop.main_segment), tracks)

    write_pose_graph(out / "posegraph.g2o", map_.T_wk, loop_pose_graph.build(sparse_map, accepted, cfg.loop))
    write_candidates(out / "candidates.csv", tried)
    save_map(out, inputs.load(FrameTimes, "extract"), tracks, map_)
    several = place_recordings(inputs, out, tracks, map_) if when.is_of_several else None
    for apart in several.warnings() if several is not None else segments_apart(tracks, map_):
        tools.warn(apart)
    moving, motion = find_moving(inputs, hidden, tracks, map_, several, tools)
    first = inputs.load(Tracks, "track"), inputs.load(Map, "track")
    doubts = pose_doubt.judge(moving_parts.views(inputs, tracks, map_), moving.moving, hidden.moving, first, (tracks, map_))
    for artifact in (moving, doubts, when, closures_of(accepted)):
        artifacts.save(artifact, out)
    write_camera(out, camera)
    figures: Summary = {
        "frames": len(features.stamp),
        "candidates": len(tried),
        "closures": len(accepted),
        "segments": map_segments.n_segments(map_),
        "lost": int((tracks.state == LOST).sum()),
        "apart": int((frame_segments(tracks, map_) > 0).sum()),
        "landmarks": len(map_.lm_xyz),
        "doubtful": doubts.n_doubtful,
    }
    if several is not None:
        figures["recordings"] = several.counts()
    return figures | motion | doubt.to_summary(pose_doubt.findings(doubts))


def close_loops(
    inputs: Inputs, sparse_map: SparseMap, frames: FrameStore, objections: Objections, cfg: Config, tools: Tools
) -> list[Candidate]:
    """Join the map's segments and close its loops, if that is wanted; returns all candidates with their fate."""
    if not cfg.loop.enabled or len(sparse_map.kf) <= FEWEST_KEY_FRAMES:
        return []
    closer = LoopCloser(sparse_map, inputs.load(Words, "match"), frames, cfg.loop, tools.rng(), objections)
    return closer.close_loops(tools.progress)


def find_moving(
    inputs: Inputs, hidden: Moving, tracks: Tracks, map_: Map, several: of_several.Placed | None, tools: Tools
) -> tuple[Moving, Summary]:
    """Find what the maps are to leave out: what moves, and what a later recording shows to be gone; returns also how much moves.

    hidden : what tracking left out; where it is nothing, nothing moves
    """
    moving = moving_parts.find(inputs, tracks, map_, tools, rule=FOR_MAPS) if len(hidden.moving) else hidden
    motion = moving_parts.figures(moving)
    if several is not None:
        moving = moving_parts.with_gone(inputs, moving, several.recording_of_frame, tracks, map_, tools)
    return moving, motion


def place_recordings(inputs: Inputs, out: Path, tracks: Tracks, map_: Map) -> of_several.Placed:
    """Say where the recordings of a run of several came to lie, and write what such a run has besides."""
    placed = of_several.Placed(of_several.recording_names(inputs), inputs.load(Recordings, "extract"), tracks, map_)
    placed.save(out, inputs.load(DepthTimes, "optimize"))
    return placed


def segments_apart(tracks: Tracks, map_: Map) -> list[str]:
    """Say which map segments could not be joined."""
    return [
        f"{told}, could not be joined: their poses, in a frame of their own, are in {segment_file(segment)}; no map shows them"
        for segment, told in enumerate(describe_other_segments(tracks, map_), start=1)
    ]


def main_first(map_: Map, tracks: Tracks, main: int) -> Map:
    """Number the segments by size and make the one that was asked for the main one."""
    map_ = map_segments.ranked(map_, tracks)  # leaves no gap in the numbers where segments were joined
    n = max(1, map_segments.n_segments(map_))
    if main >= n:
        raise SlamError(f"loop.main_segment = {main}: the map has {n} segment{'s' * (n > 1)}; give a number below {n}")
    return map_segments.ranked(map_, tracks, main)


def closures_of(accepted: list[Candidate]) -> Closures:
    """Return accepted closures as an artefact."""
    return Closures(
        closure_kf=np.array([(c.kf_i, c.kf_j) for c in accepted], dtype=np.int32).reshape(-1, 2),
        closure_T_ij=np.array([c.T_ij for c in accepted], dtype=np.float64).reshape(-1, 4, 4),
        closure_inliers=np.array([c.n_inliers for c in accepted], dtype=np.int32),
        closure_score=np.array([c.score for c in accepted], dtype=np.float32),
    )


def write_candidates(path: Path, candidates: list[Candidate]) -> None:
    """Write the table of accepted and rejected candidates with the reason."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["kf_i", "kf_j", "score", "matches", "inliers", "accepted", "reason"])
    for c in candidates:
        writer.writerow([c.kf_i, c.kf_j, f"{c.score:.4f}", c.n_matches, c.n_inliers, int(c.is_accepted), c.reason])
    files.write_text(path, text.getvalue())


def write_pose_graph(path: Path, T_wk: np.ndarray, graph: loop_pose_graph.PoseGraph) -> None:
    """Write the key frames, the edges between them as the final map has them, and the closures as they were measured."""
    write_g2o(path, T_wk, graph.edges.kf, graph.edges.T_ij, graph.edges.information)
