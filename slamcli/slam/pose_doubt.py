"""How far each frame's pose can be trusted, by signs that do not depend on one another.

* Other views look through what a frame sees: things moved that were not found, or the pose is wrong. Poses that are right leave next to
  nothing of it, poses that follow somebody through a room a tenth of all surface and more.
* Tracking and the final pass disagree about the motion within half a second.
* Few landmarks hold the pose, and no depth image in their stead; or it is unknown.
* Most of the view moves.
* Where things move, frames between this one and those that landmarks hold best are held by few, or by none: what each of them may be off
  adds up. Where nothing moves depth holds such frames, and the path of somebody who fills the view is not taken for the camera's.
"""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from slamcli.geometry import se3
from slamcli.geometry.algebra import inverse, product
from slamcli.schema import ON_DEPTH, Doubt, Map, Tracks, poses_in_segments
from slamcli.slam import doubt, moving_objects
from slamcli.slam.depth_views import Views
from slamcli.slam.doubt import Finding

EVERY = 4  # frames from one whose view is compared with others to the next
SPAN = 0.5  # [s] of the motion that tracking and the final pass are compared over
LANDMARK_SIGMA = 0.3  # [m] standard deviation of a pose is about this over the number of landmarks: 3 mm with 100
BASE_SIGMA, WORST_SIGMA = 0.002, 0.05  # [m] at best; where fewer than six landmarks hold the pose
DEPTH_SIGMA = 0.01  # [m] of a pose that the shape in a depth image holds; in dark simulated rooms it is 1 to 7 mm
CONTRADICTED = 0.03  # share of the surface; right poses leave 0.01 on real recordings, wrong ones 0.06 and more
DISAGREEMENT = 0.03  # [m]
DOUBTFUL_SIGMA = 0.03  # [m]
MOVING = 0.6  # share of a view
SHOWN = 100  # landmarks that hold a pose, from which on a view that mostly moves still shows the static world beside it
# [m] by which the motion from one frame to the next errs over the number of landmarks, at best, where few hold it, where no static world shows
STEP_LANDMARK_SIGMA, STEP_BEST, STEP_WORST, STEP_BLIND = 0.2, 0.001, 0.005, 0.02
TIED = 30  # landmarks that two key frames share, so that nothing that happened between them tears them apart
TIE_SIGMA = 0.003  # [m] of their relative pose
DOUBTFUL_DRIFT = 0.028  # [m]


def judge(views: Views, moving: np.ndarray, hidden: np.ndarray, first: tuple[Tracks, Map], final: tuple[Tracks, Map]) -> Doubt:
    """Weigh the signs for every frame.

    views : with the final poses; moving : (F, v, u) bool, without rows where nothing moves, as the maps leave it out
    hidden : the same, as tracking and the final pass left it out, who take less for moving
    first, final : the poses of tracking and of the final pass
    """
    tracks, n = final[0], len(views.stamp)
    contradicted = _contradicted(views, moving)
    disagreement = _disagreement(views.stamp, first, final)
    share = hidden.mean(axis=(1, 2)) if len(hidden) else np.zeros(n)
    support = np.minimum(LANDMARK_SIGMA / np.maximum(tracks.n_inliers, 1), np.where(_on_depth(*final), DEPTH_SIGMA, WORST_SIGMA))
    sigma = np.sqrt(BASE_SIGMA**2 + support**2 + np.nan_to_num(disagreement) ** 2)
    is_wrong, is_crowded = (np.nan_to_num(contradicted) > CONTRADICTED) | (tracks.ref_kf < 0), share > MOVING
    is_doubtful = is_wrong | is_crowded | (sigma > DOUBTFUL_SIGMA) | (np.nan_to_num(disagreement) > DISAGREEMENT)
    is_blind = is_wrong | (is_crowded & (tracks.n_inliers < SHOWN))
    drift = _drift(tracks, final[1], is_blind) if len(hidden) else np.zeros(n)
    is_doubtful |= drift > DOUBTFUL_DRIFT
    sigma = np.where(tracks.ref_kf >= 0, sigma, np.nan)
    return Doubt(
        contradicted=contradicted.astype(np.float32),
        disagreement=disagreement.astype(np.float32),
        sigma=sigma.astype(np.float32),
        drift=drift.astype(np.float32),
        is_doubtful=is_doubtful,
    )


def _drift(tracks: Tracks, map_: Map, is_blind: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation (F,) [m] of each frame's position beside the longest stretch of frames that landmarks hold well.

    is_blind : (F,) frames that show no static world, or contradict it
    Variances add up along the shortest way there: from frame to frame, from key frame to key frame that see the same, and along edges of the
    map, unless they lead past frames that are blind: what is aligned there may be somebody who fills the view.
    """
    n = len(is_blind)
    step = np.clip(STEP_LANDMARK_SIGMA / np.maximum(tracks.n_inliers, 1), STEP_BEST, STEP_WORST)
    step[is_blind] = STEP_BLIND
    frames = np.arange(n - 1)
    variance = np.maximum(step[1:], step[:-1]) ** 2
    ties, (edges, edge_variance) = _ties(map_, is_blind), _edges(map_, is_blind)
    row, column = np.concatenate([frames, ties[:, 0], edges[:, 0]]), np.concatenate([frames + 1, ties[:, 1], edges[:, 1]])
    value = np.concatenate([variance, np.full(len(ties), TIE_SIGMA**2), edge_variance])
    order = np.argsort(-value, kind="stable")  # of several ways between two frames, the last one written is the best
    graph = sparse.lil_matrix((n, n))
    graph[row[order], column[order]] = value[order]
    held = doubt.doubtful_frames(step <= np.quantile(step, 0.5))  # stretches at least as well held as half of the frames
    first, last = max(held, key=lambda stretch: stretch[1] - stretch[0])
    away = csgraph.dijkstra(graph.tocsr(), directed=False, indices=(first + last) // 2)
    return np.sqrt(away)


def _ties(map_: Map, is_blind: np.ndarray) -> np.ndarray:
    """List pairs (N, 2) of frames, both key frames that are not blind, that share at least TIED landmarks: first and last, or one after the other.

    What happened between two such frames does not tear them apart, so the blind ones are passed over.
    """
    sees = ~is_blind[map_.kf_frame[map_.obs_kf]]
    landmark, kf = map_.obs_lm[sees], map_.obs_kf[sees]
    if len(landmark) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    goes_on = landmark[1:] == landmark[:-1]
    starts, ends = np.flatnonzero(np.append(True, ~goes_on)), np.flatnonzero(np.append(~goes_on, True))
    listed = [np.stack([kf[:-1][goes_on], kf[1:][goes_on]], axis=1), np.stack([kf[starts], kf[ends]], axis=1)]
    tied = []
    for each in listed:
        pairs, n_shared = np.unique(each, axis=0, return_counts=True)
        tied.append(pairs[(n_shared >= TIED) & (pairs[:, 0] != pairs[:, 1])])
    return map_.kf_frame[np.concatenate(tied)].astype(np.int64)


def _edges(map_: Map, is_blind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List pairs (N, 2) of frames, both key frames, that edges of the map join, with the variance (N,) [m^2] of their relative position."""
    frames = np.sort(map_.kf_frame[map_.edge_kf].astype(np.int64).reshape(-1, 2), axis=1)
    n_blind = np.concatenate([[0], np.cumsum(is_blind)])
    sees = n_blind[frames[:, 1] + 1] == n_blind[frames[:, 0]]
    covariance = inverse(map_.edge_information[sees])
    return frames[sees], covariance[:, 0, 0] + covariance[:, 1, 1] + covariance[:, 2, 2]


def findings(record: Doubt) -> list[Finding]:
    """Sum up what the frames' signs say of the run; a frame without a pose has none to be wrong."""
    n, n_poses = record.n_doubtful, int(np.isfinite(record.sigma).sum())
    if n == 0:
        return []
    share, contradicted = n / n_poses, float(np.nanmean(np.append(record.contradicted, 0.0)))
    text = f"the poses of {n} of {n_poses} frames are doubtful"
    if contradicted > CONTRADICTED:
        text += f", as other views look through {contradicted:.0%} of what is seen: much moves, or the poses are wrong"
    return [Finding("poses", text + doubt.SEE_REPORT, is_grave=share >= doubt.MANY)]


def _on_depth(tracks: Tracks, map_: Map) -> np.ndarray:
    """Find the frames (F,) that their depth images place: aligned with a key frame's, or key frames themselves that edges join."""
    is_placed = tracks.state == ON_DEPTH
    is_placed[map_.kf_frame[np.unique(map_.edge_kf)]] = True
    return is_placed


def _contradicted(views: Views, moving: np.ndarray) -> np.ndarray:
    """Find the share (F,) of the surface that other views look through, what is known to move left out; every few frames anew."""
    share = np.full(len(views.stamp), np.nan)
    for frame in range(0, len(share), EVERY):
        evidence = moving_objects.weigh(views, frame, moving_objects.QUICK_AFTER)
        if evidence is None:
            continue
        area = evidence.depth**2 if len(moving) == 0 else np.where(moving_objects.with_margin(moving[frame]), 0.0, evidence.depth**2)
        against = area[(evidence.n_through > 0) & (evidence.n_through >= evidence.n_still)].sum()
        agreed = area[evidence.n_still > evidence.n_through].sum()
        share[frame : frame + EVERY] = against / (against + agreed) if against + agreed > 0 else np.nan
    return share


def _disagreement(stamp: np.ndarray, first: tuple[Tracks, Map], final: tuple[Tracks, Map]) -> np.ndarray:
    """Find by how much (F,) [m] two passes differ about the motion from SPAN before to each frame, NaN where one does not know it."""
    later = np.arange(len(stamp))
    before = np.minimum(np.searchsorted(stamp, stamp - SPAN), later)
    motion = []
    for tracks, map_ in (first, final):
        segment, T_wc = poses_in_segments(tracks, map_)
        T_wc[before[segment != segment[before]]] = np.nan
        motion.append(product(se3.inverse(T_wc[before]), T_wc))
    return np.linalg.norm(product(se3.inverse(motion[0]), motion[1])[:, :3, 3], axis=1)
