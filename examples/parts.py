"""Use the library's parts without the pipeline: a tracker, a loop closer, the alignment of two depth images, an octree, a bundle adjustment.

    python examples/parts.py [RECORDING]

RECORDING is anything that `slamcli run` takes; without it the demo is used, a simulated room. The pipeline makes features, words and
matches of it; everything after that is called here.
"""

import sys

import numpy as np

import slamcli
from slamcli.console import silent
from slamcli.dense.occupancy import OccupancyMap
from slamcli.depth import icp
from slamcli.estimation import bundle_adjustment
from slamcli.estimation.bundle_problem import Problem, Variables
from slamcli.geometry import octree, se3
from slamcli.schema import LOST, Features, Map, Matches, Tracks, Words, frame_poses
from slamcli.slam.loop_closing import LoopCloser
from slamcli.slam.recording import TrackingInput
from slamcli.slam.tracker import Tracker
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap


def main(recording: str = "demo") -> None:
    """Call one part after the other, and print each field of what it returns."""
    run = slamcli.run(recording, until="match")
    tracks, map_ = track(run)
    close_loops(run, map_)
    align(run, tracks, map_)
    map_space(run, tracks, map_)
    adjust(run, map_)


def track(run: slamcli.Run, n_frames: int = 40) -> tuple[Tracks, Map]:
    """Track the first frames: a pose for each, and a map of key frames and landmarks."""
    features, words, matches = (
        run.directory.load(cls, stage) for cls, stage in ((Features, "extract"), (Words, "match"), (Matches, "match"))
    )
    config = run.config()
    frames = FrameStore(features, run.camera("extract"), config.sensor)
    tracker = Tracker(TrackingInput(frames, words, matches), config.track, np.random.default_rng(config.seed))
    n_frames = min(n_frames, len(features.stamp))
    for i in range(n_frames):
        tracker.process(i)
    tracks, map_ = tracker.tracks(), tracker.map()

    print("Tracker.tracks() and .map()")
    line("state", f"{np.count_nonzero(tracks.state != LOST)} of {n_frames} frames tracked; 0 = lost")
    line(
        "ref_kf, T_kc",
        f"pose of frame {n_frames - 1} relative to key frame {tracks.ref_kf[n_frames - 1]}: {short(tracks.T_kc[n_frames - 1])}",
    )
    line("n_inliers", f"{np.median(tracks.n_inliers[:n_frames]):.0f} landmarks hold a pose, median")
    line("kf_frame, T_wk", f"{len(map_.kf_frame)} key frames: frames {map_.kf_frame.tolist()}; camera to world")
    line("lm_xyz", f"{len(map_.lm_xyz)} landmarks [m, world]")
    line("obs_lm, obs_kf, obs_row", f"{len(map_.obs_lm)} observations: landmark, key frame, row in Features")
    return tracks, map_


def close_loops(run: slamcli.Run, map_: Map) -> None:
    """Look for places that the map shows twice, and move it so that they coincide."""
    config = run.config()
    features, words = run.directory.load(Features, "extract"), run.directory.load(Words, "match")
    frames, sparse_map = FrameStore(features, run.camera("extract"), config.sensor), SparseMap.from_map(features, map_)
    closer = LoopCloser(sparse_map, words, frames, config.loop, np.random.default_rng(config.seed))
    tried = closer.close_loops(silent)
    closed = sparse_map.snapshot()

    print(f"LoopCloser.close_loops(), {len(map_.kf_frame)} key frames")
    line("kf_i, kf_j", f"{len(tried)} pairs of key frames may show the same place: {[(c.kf_i, c.kf_j) for c in tried]}")
    line("score", f"{[round(c.score, 2) for c in tried]}, how alike their words are; is_by_pose: {[c.is_by_pose for c in tried]}")
    line("n_matches, n_inliers", f"{[(c.n_matches, c.n_inliers) for c in tried]}, by which each was verified")
    line("reason, T_ij", f"{sum(c.is_accepted for c in tried)} are accepted, and have no reason against them: {[c.reason for c in tried]}")
    line("T_wk", f"key frames moved by {1000 * max(map(apart, closed.T_wk, map_.T_wk)):.1f} mm at most")


def align(run: slamcli.Run, tracks: Tracks, map_: Map) -> None:
    """Align the depth images of two neighbouring key frames, starting where the tracker put them."""
    dataset, camera, sensor = run.dataset(), run.camera("extract"), run.config().sensor
    j, i = (int(frame) for frame in map_.kf_frame[:2]) if len(map_.kf_frame) > 1 else (0, 1)
    source, target = (icp.surface_points(icp.coarsen(dataset.depth(frame)), camera, sensor) for frame in (j, i))
    T_wc = frame_poses(tracks, map_)
    start = se3.inverse(T_wc[i]) @ T_wc[j]
    found = icp.align(start, source, target)

    print(f"icp.align(), frame {j} onto frame {i}")
    line("T_ij", f"{short(found.T_ij)}; x_i = T_ij x_j; the tracker said {short(start)}")
    line("overlap", f"{found.overlap:.0%} of the points of j lie on the surface of i")
    line("agreement", f"{found.agreement:.0%} of those that meet a point of i")
    line("rms", f"{found.rms:.2f} standard deviations of a reading")
    line("information", f"inverse covariance; {icp.n_determined(found.information, found.depth)} of 6 directions are determined")
    line("depth", f"{found.depth:.2f} m, mean of the points of j")
    line("iterations, is_converged", f"{found.iterations}, {found.is_converged}")


def map_space(run: slamcli.Run, tracks: Tracks, map_: Map) -> None:
    """Insert the depth image of the first key frame into an octree as one scan."""
    frame, option, camera = int(map_.kf_frame[0]), run.config().octree, run.camera("extract")
    depth, T_wc = run.dataset().depth(frame)[:: option.stride, :: option.stride], frame_poses(tracks, map_)[frame]
    v, u = np.mgrid[: camera.height : option.stride, : camera.width : option.stride]
    x_c = camera.backproject(camera.undistort(np.stack([u, v], axis=-1)), depth)
    space = OccupancyMap(option.resolution, hit=option.hit, miss=option.miss, clamp_min=option.clamp_min, clamp_max=option.clamp_max)
    space.insert(se3.transform(T_wc, x_c.reshape(-1, 3)), T_wc[:3, 3], max_range=option.max_range)
    cells = space.leaves()
    tree = octree.prune(cells)

    print(f"OccupancyMap.insert(), frame {frame}")
    line("log_odds", f"{int(cells.is_occupied().sum())} cells occupied, {int((~cells.is_occupied()).sum())} free")
    line("centre, side", f"{len(tree)} leaves after pruning, of {tree.side.min():.2f} to {tree.side.max():.2f} m")


def adjust(run: slamcli.Run, map_: Map) -> None:
    """Adjust all key frames but the first, and all landmarks, after moving the last key frame by 2 cm."""
    camera, sensor = run.camera("extract"), run.config().sensor
    sparse_map = SparseMap.from_map(run.directory.load(Features, "extract"), map_)
    part = map_adjustment.gather(sparse_map, np.arange(len(map_.kf_frame), dtype=np.int32), sensor)
    T_kw = sparse_map.T_kw(part.kfs)
    moved = T_kw.copy()
    moved[-1] = se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])) @ moved[-1]
    start = Variables(moved, sparse_map.lm.xyz[part.ids])
    found = bundle_adjustment.adjust(Problem(start, part.seen, camera, is_fixed=part.is_fixed))

    print(f"bundle_adjustment.adjust(), {len(part.kfs)} key frames and {len(part.ids)} landmarks")
    line(
        "T_cw",
        f"the last key frame is {1000 * apart(moved[-1], T_kw[-1]):.1f} mm off before, {1000 * apart(found.T_cw[-1], T_kw[-1]):.1f} mm after",
    )
    line("x_w", f"landmarks [m, world], {found.x_w.shape}")
    line("cost", f"{found.cost[0]:.0f} at the start, {found.cost[-1]:.0f} at the end: robust chi2 of {len(part.seen)} observations")
    line("chi2, is_inlier", f"{found.is_inlier.mean():.0%} of the observations are within the 95 % quantile")
    line("iterations, is_converged", f"{found.iterations}, {found.is_converged}")


def apart(T_a: np.ndarray, T_b: np.ndarray) -> float:
    """Return how far apart two poses lie [m]."""
    return float(np.linalg.norm(se3.log(T_a @ se3.inverse(T_b))[:3]))


def short(T: np.ndarray) -> str:
    """Write a pose as its translation [mm] and its angle of rotation [degrees]."""
    xi = se3.log(T)
    x, y, z = 1000.0 * T[:3, 3]
    return f"({x:.1f}, {y:.1f}, {z:.1f}) mm, {np.degrees(np.linalg.norm(xi[3:])):.2f} degrees"


def line(field: str, meaning: str) -> None:
    """Print one field of a result."""
    print(f"  {field:24s} {meaning}")


if __name__ == "__main__":
    main(*sys.argv[1:])
