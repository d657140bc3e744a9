"""Loop closing: places seen again are recognized, verified, and pulled together."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from slamcli.config.options import LoopConfig, SensorConfig
from slamcli.estimation import camera_pose, pose_graph
from slamcli.geometry import se3
from slamcli.geometry.camera import Camera
from slamcli.schema import Words
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.sparse_map import guided_matching, map_adjustment
from slamcli.sparse_map.frame import frame_features, refine_on_landmarks
from slamcli.sparse_map.landmark_fusion import fuse_landmarks
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.vision import hamming

# Between neighbours that share 100 landmarks [m, rad]. In simulated rooms the drift over 20 to 50 key frames is a fourth to an eighth of
# what follows from it: a true closure must not be dropped where tracking was poor, and a false one is metres off.
ODOMETRY_SIGMA = np.array([0.02, 0.02, 0.02, 0.01, 0.01, 0.01])
SHAPE_SUPPORT = 100  # landmarks that two depth images aligned are worth in the pose graph
AHEAD = 2.0  # [m] before the camera, what it looks at
MIN_COSINE = 0.7  # between the directions of two views of one spot


@dataclass(frozen=True)
class Candidate:
    """Two key frames that may show the same place, and what became of the idea."""

    kf_i: int
    kf_j: int
    score: float  # similarity of the word vectors, [Z] (10)
    n_matches: int = 0  # features under the same vocabulary node
    n_inliers: int = 0  # landmarks around j found in i
    reason: str = ""  # why it was rejected; empty = accepted
    T_ij: np.ndarray | None = None
    information: np.ndarray | None = None  # (6, 6) of T_ij, twist order
    is_near: bool = False  # named by the poses of now, not by the words

    @property
    def is_accepted(self) -> bool:
        """Say whether the place was verified."""
        return not self.reason


def find_candidates(sparse_map: SparseMap, places: PlaceIndex, settings: LoopConfig) -> list[Candidate]:
    """List pairs of key frames whose bags of words are alike but which are not covisible, most alike first."""
    candidates = []
    for i in range(len(sparse_map.kf)):
        scores = places.scores(i)
        shared = sparse_map.votes(sparse_map.landmarks_of(i))
        # Each vocabulary has its own range of scores: a place seen again should look as alike as the worst of the neighbours, [ORB-SLAM].
        neighbours = np.flatnonzero(shared >= settings.min_shared)
        neighbours = neighbours[neighbours != i]
        floor = (
            settings.min_score if len(neighbours) == 0 else min(settings.min_score, settings.score_share * float(scores[neighbours].mean()))
        )
        scores[shared >= settings.min_shared] = 0.0
        scores[i:] = 0.0
        for j in np.argsort(-scores, kind="stable")[: settings.candidates]:
            if scores[j] >= floor and scores[j] > 0.0:
                candidates.append(Candidate(i, int(j), float(scores[j])))
    return sorted(candidates, key=lambda c: (-c.score, c.kf_i, c.kf_j))


def find_near(sparse_map: SparseMap, places: PlaceIndex, settings: LoopConfig) -> list[Candidate]:
    """List pairs of key frames that view the same place according to their current poses but are not covisible, sorted by distance.

    Words miss such pairs when little of the two views is in common, as on either side of a gap, or when both are seen at an angle.
    """
    candidates = []
    spot = sparse_map.kf.T_wk[:, :3, 3] + AHEAD * sparse_map.kf.T_wk[:, :3, 2]
    for i in range(1, len(sparse_map.kf)):
        is_open = sparse_map.votes(sparse_map.landmarks_of(i))[:i] < settings.min_shared
        is_open &= sparse_map.kf.segment[:i] == sparse_map.kf.segment[i]
        is_open &= sparse_map.kf.T_wk[:i, :3, 2] @ sparse_map.kf.T_wk[i, :3, 2] > MIN_COSINE
        apart = np.where(is_open, np.linalg.norm(spot[:i] - spot[i], axis=1), np.inf)
        j = int(np.argmin(apart))
        if apart[j] < settings.near:
            candidates.append((float(apart[j]), Candidate(i, j, float(places.scores(i)[j]), is_near=True)))
    return [c for _, c in sorted(candidates, key=lambda pair: (pair[0], pair[1].kf_i))]


def verify(
    sparse_map: SparseMap,
    words: Words,
    candidate: Candidate,
    camera: Camera,
    settings: LoopConfig,
    sensor: SensorConfig,
    rng: np.random.Generator,
) -> Candidate:
    """Check a candidate by geometry: 3-D to 3-D RANSAC, for a near one the poses of now; then the landmarks around j looked for in i."""
    frame_i, frame_j = (
        frame_features(sparse_map.features, int(sparse_map.kf.frame[kf]), camera, sensor) for kf in (candidate.kf_i, candidate.kf_j)
    )
    if candidate.is_near:
        return _find_landmarks(sparse_map, candidate, frame_i, se3.inverse(sparse_map.kf.T_wk[candidate.kf_i]), camera, settings)
    node_i, node_j = (np.array(words.node[f.first_row : f.first_row + len(f)]) for f in (frame_i, frame_j))
    rows, _ = hamming.match_nodes(frame_i.desc.view(np.uint8), node_i, frame_j.desc.view(np.uint8), node_j, frame_i.angle, frame_j.angle)
    has_depth = np.isfinite(frame_i.depth[rows[:, 0]]) & np.isfinite(frame_j.depth[rows[:, 1]])
    rows = rows[has_depth]
    candidate = replace(candidate, n_matches=len(rows))
    if len(rows) < settings.min_matches:
        return replace(candidate, reason=f"{len(rows)} of {settings.min_matches} matches")
    x_i = camera.backproject(frame_i.xy[rows[:, 0]], frame_i.depth[rows[:, 0]])
    x_j = camera.backproject(frame_j.xy[rows[:, 1]], frame_j.depth[rows[:, 1]])
    start = camera_pose.ransac_rigid(
        x_j,
        x_i,
        frame_j.xy[rows[:, 1]],
        frame_i.xy[rows[:, 0]],
        camera,
        rng=rng,
        rounds=settings.ransac_rounds,
        threshold_px=settings.ransac_threshold_px,
    )
    if start is None:
        return replace(candidate, reason="no rigid motion explains the matches")
    T_iw = start.T_cw @ se3.inverse(sparse_map.kf.T_wk[candidate.kf_j])
    return _find_landmarks(sparse_map, candidate, frame_i, T_iw, camera, settings)


def _find_landmarks(
    sparse_map: SparseMap,
    candidate: Candidate,
    frame_i: guided_matching.FrameFeatures,
    T_iw: np.ndarray,
    camera: Camera,
    settings: LoopConfig,
) -> Candidate:
    """Look for the landmarks around j in i, from a guess of its pose T_iw in the world that j stands in."""
    neighbours, _ = sparse_map.covisible(candidate.kf_j)
    ids = sparse_map.landmarks_in(np.append(neighbours[: settings.neighbours], candidate.kf_j))
    landmarks = sparse_map.candidates(ids)
    for radius in (4.0, 2.0):
        feature, _ = guided_matching.search(
            T_iw,
            landmarks,
            frame_i,
            camera,
            octave_scale=sparse_map.octave_scale,
            radius_px=radius * settings.search_radius_px,
            max_distance=64,
            ratio=0.9,
        )
        which = np.flatnonzero(feature >= 0)
        if len(which) < settings.min_inliers:
            return replace(candidate, n_inliers=len(which), reason=f"{len(which)} of {settings.min_inliers} landmarks found again")
        estimate = refine_on_landmarks(T_iw, landmarks.xyz[which], frame_i, feature[which], camera)
        T_iw = estimate.T_cw
    candidate = replace(candidate, n_inliers=estimate.n_inliers)
    if estimate.n_inliers < settings.min_inliers:
        return replace(candidate, reason=f"{estimate.n_inliers} of {settings.min_inliers} landmarks agree")
    return replace(candidate, T_ij=T_iw @ sparse_map.kf.T_wk[candidate.kf_j], information=estimate.information)


@dataclass(frozen=True)
class PoseGraph:
    """Edges between key frames."""

    edge_kf: np.ndarray  # (E, 2) key frames (i, j)
    edge_T_ij: np.ndarray  # (E, 4, 4), x_i = T_ij @ x_j
    information: np.ndarray  # (E, 6, 6), twist order
    is_closure: np.ndarray  # (E,) bool


def build_pose_graph(sparse_map: SparseMap, closures: list[Candidate], settings: LoopConfig) -> PoseGraph:
    """Return the edges between covisible key frames, which hold what the map says now, followed by the closures."""
    edge_kf, n_shared = covisibility_edges(sparse_map, settings)
    T_ij = se3.inverse(sparse_map.kf.T_wk[edge_kf[:, 0]]) @ sparse_map.kf.T_wk[edge_kf[:, 1]]
    support = np.append(n_shared, [float(min(c.n_inliers, 300)) for c in closures])
    return PoseGraph(
        edge_kf=np.concatenate([edge_kf, np.array([(c.kf_i, c.kf_j) for c in closures], dtype=np.int32).reshape(-1, 2)]),
        edge_T_ij=np.concatenate([T_ij, np.array([c.T_ij for c in closures]).reshape(-1, 4, 4)]),
        information=np.diag(ODOMETRY_SIGMA**-2.0) * (support / 100.0)[:, None, None],
        is_closure=np.arange(len(support)) >= len(edge_kf),
    )


def close(sparse_map: SparseMap, closures: list[Candidate], settings: LoopConfig) -> pose_graph.PoseGraphResult:
    """Spread the closures' corrections over the key frames; [L] (13). Closures that the rest of the graph contradicts are dropped."""
    graph = build_pose_graph(sparse_map, closures, settings)
    is_fixed = np.zeros(len(sparse_map.kf), dtype=bool)
    is_fixed[np.unique(sparse_map.kf.segment, return_index=True)[1]] = True
    return pose_graph.optimize(
        sparse_map.kf.T_wk, graph.edge_kf, graph.edge_T_ij, graph.information, is_fixed=is_fixed, is_robust=graph.is_closure
    )


def is_near(a: Candidate, b: Candidate, *, span: int) -> bool:
    """Say whether two candidates claim the same revisit."""
    return abs(a.kf_i - b.kf_i) <= span and abs(a.kf_j - b.kf_j) <= span


class Claims:
    """Claims of revisits so far; whether a candidate is near one of them is found among those in the cells around it alone."""

    def __init__(self, candidates: Iterable[Candidate], *, span: int) -> None:
        """Take the first claims; span : key frames that one claim covers to either side, see `is_near`."""
        self._span = span
        self._cells: dict[tuple[int, int], list[Candidate]] = {}
        for c in candidates:
            self.add(c)

    def add(self, c: Candidate) -> None:
        """Note one more claim."""
        self._cells.setdefault(self._cell(c), []).append(c)

    def cover(self, c: Candidate) -> bool:
        """Say whether a candidate claims the same revisit as any of them."""
        i, j = self._cell(c)
        around = (self._cells.get((i + down, j + right), ()) for down in (-1, 0, 1) for right in (-1, 0, 1))
        return any(is_near(c, other, span=self._span) for cell in around for other in cell)

    def _cell(self, c: Candidate) -> tuple[int, int]:
        return c.kf_i // (self._span + 1), c.kf_j // (self._span + 1)


def spread(candidates: list[Candidate], *, span: int) -> list[Candidate]:
    """Keep the first of those that claim the same revisit."""
    kept, claims = [], Claims((), span=span)
    for c in candidates:
        if not claims.cover(c):
            kept.append(c)
            claims.add(c)
    return kept


def reject(candidate: Candidate, reason: str) -> Candidate:
    """Return the candidate as rejected."""
    return replace(candidate, reason=reason)


def covisibility_edges(sparse_map: SparseMap, settings: LoopConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of key frames (E, 2) that share landmarks or a shape, and how many; neighbours in time within a segment always belong."""
    edges, weights = [], []
    for i in range(1, len(sparse_map.kf)):
        shared = sparse_map.votes(sparse_map.landmarks_of(i))[:i]
        joined = np.flatnonzero(shared >= settings.edge_shared)
        before = np.flatnonzero(sparse_map.kf.segment[:i] == sparse_map.kf.segment[i])[-1:]
        on_depth = sparse_map.edge.kf[sparse_map.edge.kf[:, 0] == i, 1]
        shared[on_depth] = np.maximum(shared[on_depth], SHAPE_SUPPORT)
        joined = np.union1d(joined[np.argsort(-shared[joined], kind="stable")[: settings.edges_per_key_frame]], np.append(before, on_depth))
        edges += [(i, int(j)) for j in joined]
        weights += [max(int(shared[j]), 1) for j in joined]
    return np.array(edges, dtype=np.int32).reshape(-1, 2), np.array(weights, dtype=np.float64)


def apply(sparse_map: SparseMap, T_wk: np.ndarray) -> None:
    """Move the key frames to `T_wk` and every landmark along with the key frame that created it."""
    before = sparse_map.kf.T_wk.copy()
    sparse_map.kf.T_wk[:] = T_wk
    alive = np.flatnonzero(sparse_map.lm.is_alive).astype(np.int32)
    map_adjustment.carry(sparse_map, alive, np.arange(len(sparse_map.kf)), before)


def fuse_around(sparse_map: SparseMap, closure: Candidate, camera: Camera, settings: LoopConfig, sensor: SensorConfig) -> int:
    """Find each side's landmarks in the key frames of the other side; returns how many were joined."""
    sides = []
    for kf in (closure.kf_i, closure.kf_j):
        neighbours, shared = sparse_map.covisible(kf)
        sides.append(np.append(neighbours[shared >= settings.edge_shared][: settings.neighbours], kf))
    n = 0
    for here, there in (sides, sides[::-1]):
        for kf in here:
            n += fuse_landmarks(
                sparse_map, int(kf), sparse_map.landmarks_in(there), camera, sensor, max_distance=settings.fuse_max_distance
            )
    return n
