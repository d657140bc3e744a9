"""loop: places seen again are joined, the whole map is adjusted, and all frames meet it once more."""

import csv
import io
import itertools
from pathlib import Path

import numpy as np

from slamcli import artifacts, files
from slamcli.calibration import self_calibration
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.formats.g2o import write_g2o
from slamcli.geometry.camera import Camera
from slamcli.schema import LOST, Closures, Map, Moving, Timing, Tracks, Words, frame_segments
from slamcli.slam import doubt, final_refinement, loop_closing, map_merging, map_segments, pose_doubt
from slamcli.slam.depth_tracking import FramePoints
from slamcli.slam.loop_closing import Candidate, Claims
from slamcli.slam.moving_objects import FOR_MAPS
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import moving_parts
from slamcli.stages.camera_file import write_camera
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.map_outputs import describe_other_segments, save_map, segment_file


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Join map segments and close loops until no new one appears; then look at all key frames and frames again."""
    words, tracks = inputs.load(Words, "match"), inputs.load(Tracks, "optimize")
    when, camera = inputs.load(Timing, "optimize"), inputs.camera("optimize")
    given, sensing = inputs.camera(), Sensing(camera, when, {})
    moving = inputs.load(Moving, "track")
    features, depth = moving_parts.still(inputs, moving)
    features = self_calibration.correct(features, given, sensing)
    sparse_map = SparseMap.from_map(features, inputs.load(Map, "optimize"))
    tried: list[Candidate] = []
    if cfg.loop.enabled and len(sparse_map.kf) > 2:
        tried = close_loops(sparse_map, words, camera, cfg, tools)
    accepted = [c for c in tried if c.is_accepted]
    if accepted and cfg.loop.final_refinement:
        tracks, _ = final_refinement.refine_all(
            sparse_map,
            tracks,
            sensing,
            cfg.sensor,
            cfg.track,
            frame_points=FramePoints(depth, given, cfg.sensor),
            depth_icp_edges=cfg.loop.depth_icp_edges,
            depth_icp_weight=cfg.loop.depth_icp_weight,
            iterations=cfg.loop.iterations,
            progress=tools.progress,
            workers=tools.workers,
        )
    map_ = map_segments.anchored(main_first(sparse_map.snapshot(), tracks, cfg.loop.main_segment), tracks)
    write_pose_graph(out / "posegraph.g2o", map_.T_wk, loop_closing.build_pose_graph(sparse_map, accepted, cfg.loop))
    write_candidates(out / "candidates.csv", tried)
    for segment, told in enumerate(describe_other_segments(tracks, map_), start=1):
        tools.warn(f"{told}, could not be joined: their poses, in a frame of their own, are in {segment_file(segment)}; no map shows them")
    save_map(out, features.stamp, tracks, map_)
    moving = moving_parts.find(inputs, tracks, map_, tools, rule=FOR_MAPS) if len(moving.moving) else moving
    artifacts.save(moving, out)
    first = inputs.load(Tracks, "track"), inputs.load(Map, "track")
    doubts = pose_doubt.judge(moving_parts.views(inputs, tracks, map_), moving.moving, first, (tracks, map_))
    artifacts.save(doubts, out)
    artifacts.save(when, out)
    write_camera(out, camera)
    artifacts.save(closures_of(accepted), out)
    return (
        {
            "frames": len(features.stamp),
            "candidates": len(tried),
            "closures": len(accepted),
            "segments": map_segments.n_segments(map_),
            "lost": int((tracks.state == LOST).sum()),
            "apart": int((frame_segments(tracks, map_) > 0).sum()),
            "landmarks": len(map_.lm_xyz),
            "doubtful": int(doubts.is_doubtful.sum()),
        }
        | moving_parts.told(moving)
        | doubt.to_summary(pose_doubt.findings(doubts))
    )


def main_first(map_: Map, tracks: Tracks, main: int) -> Map:
    """Number the segments by size and make the one that was asked for the main one."""
    map_ = map_segments.ranked(map_, tracks)  # leaves no gap in the numbers where segments were joined
    n = max(1, map_segments.n_segments(map_))
    if main >= n:
        raise SlamError(f"loop.main_segment = {main}: the map has {n} segment{'s' * (n > 1)}; give a number below {n}")
    return map_segments.ranked(map_, tracks, main)


def close_loops(sparse_map: SparseMap, words: Words, camera: Camera, cfg: Config, tools: Tools) -> list[Candidate]:
    """Search, verify, correct, fuse, adjust; again while that brings new closures. Returns all candidates with their fate."""
    places = PlaceIndex(words, sparse_map.kf.frame)
    rng = tools.rng()
    fate = join_segments(sparse_map, places, camera, cfg, rng)
    for _ in range(cfg.loop.rounds):
        new = []
        # One closure joins its whole neighbourhood: fusion finds the rest. And where the graph contradicted one, words would only
        # name its like again; what the poses of now name is another idea.
        closed = Claims((c for c in fate.values() if c.is_accepted), span=cfg.loop.closure_spacing)
        contradicted = Claims((c for c in fate.values() if not c.is_accepted and c.T_ij is not None), span=cfg.loop.closure_spacing)
        candidates = loop_closing.find_candidates(sparse_map, places, cfg.loop) + loop_closing.find_near(sparse_map, places, cfg.loop)
        for candidate in tools.progress(candidates, "loop"):
            pair = (candidate.kf_i, candidate.kf_j)
            if are_apart(sparse_map, candidate):
                continue
            if closed.cover(candidate) or (not candidate.is_near and contradicted.cover(candidate)):
                continue
            fate[pair] = loop_closing.verify(sparse_map, words, candidate, camera, cfg.loop, cfg.sensor, rng)
            if fate[pair].is_accepted:
                new.append(fate[pair])
                closed.add(fate[pair])
        if not new:
            break
        graph = loop_closing.close(sparse_map, new, cfg.loop)
        is_kept, chi2 = graph.is_kept[-len(new) :], graph.chi2[-len(new) :]
        for c, value in zip(itertools.compress(new, ~is_kept), chi2[~is_kept], strict=True):
            fate[c.kf_i, c.kf_j] = loop_closing.reject(c, f"the pose graph contradicts it (chi2 {value:.0f})")
        if not is_kept.any():
            break
        loop_closing.apply(sparse_map, graph.T_wk)
        settle(sparse_map, list(itertools.compress(new, is_kept)), camera, cfg)
    return [fate[key] for key in sorted(fate)]


def settle(sparse_map: SparseMap, closures: list[Candidate], camera: Camera, cfg: Config) -> None:
    """Fuse what both sides of the closures see, and adjust the whole map."""
    for c in closures:
        loop_closing.fuse_around(sparse_map, c, camera, cfg.loop, cfg.sensor)
    sparse_map.refresh(np.flatnonzero(sparse_map.lm.is_alive).astype(np.int32))
    kfs = np.arange(len(sparse_map.kf), dtype=np.int32)
    map_adjustment.adjust(sparse_map, kfs, camera, cfg.sensor, max_iterations=cfg.loop.iterations)


def are_apart(sparse_map: SparseMap, c: Candidate) -> bool:
    """Say whether the two key frames belong to different map segments."""
    return bool(sparse_map.kf.segment[c.kf_i] != sparse_map.kf.segment[c.kf_j])


def join_segments(
    sparse_map: SparseMap, places: PlaceIndex, camera: Camera, cfg: Config, rng: np.random.Generator
) -> dict[tuple[int, int], Candidate]:
    """Join map segments that saw the same place. Returns the fate of candidates between segments, by pair of key frames."""
    if len(np.unique(sparse_map.kf.segment)) < 2:
        return {}
    between = [c for c in loop_closing.find_candidates(sparse_map, places, cfg.loop) if are_apart(sparse_map, c)]
    tried = [loop_closing.verify(sparse_map, places.words, c, camera, cfg.loop, cfg.sensor, rng) for c in between]
    fate = [c for c in tried if not c.is_accepted]
    left = [c for c in tried if c.is_accepted]
    while found := map_merging.find_join(sparse_map, left, least=cfg.loop.join_closures):
        map_merging.join(sparse_map, found)
        settle(sparse_map, loop_closing.spread(found.closures, span=cfg.loop.closure_spacing), camera, cfg)
        fate += found.closures
        # What says otherwise is tried again like any loop, now that odometry of a kind runs between the segments.
        left = [c for c in left if are_apart(sparse_map, c)]
    alone = f"closures between the two map segments are fewer than {cfg.loop.join_closures}, or others contradict it"
    return {(c.kf_i, c.kf_j): c for c in (*fate, *(loop_closing.reject(c, alone) for c in left))}


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


def write_pose_graph(path: Path, T_wk: np.ndarray, graph: loop_closing.PoseGraph) -> None:
    """Write the key frames, the edges between them as the final map has them, and the closures as they were measured."""
    write_g2o(path, T_wk, graph.edge_kf, graph.edge_T_ij, graph.information)
