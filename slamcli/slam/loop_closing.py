"""Loop closing: join map segments, then propose, verify, correct, fuse and adjust until no new loop appears."""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from slamcli.config.options import LoopConfig
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.schema import Words
from slamcli.slam import loop_pose_graph, map_merging
from slamcli.slam.loop_candidates import Candidate, Claims, find_alike, find_by_pose, first_of_each_revisit
from slamcli.slam.loop_verification import verify
from slamcli.slam.map_merging import Join
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.landmark_fusion import fuse_landmarks
from slamcli.sparse_map.sparse_map import SparseMap

SETTLED_M, SETTLED_RAD = 0.005, 0.003  # a pixel or two: verification looks for landmarks in windows of sixteen


def no_objection(_: Join | Candidate) -> str:
    """Object to nothing."""
    return ""


@dataclass(frozen=True)
class Objections:
    """Functions that give the reason against a join or a closure, "" when there is none."""

    to_join: Callable[[Join], str] = no_objection  # of two segments; those of one recording are joined when several closures agree
    to_closure: Callable[[Candidate], str] = no_objection  # of the two sides of a verified closure within one segment


NO_OBJECTIONS = Objections()


def has_moved(before: np.ndarray, after: np.ndarray) -> bool:
    """Say whether any key frame, of poses (K, 4, 4), moved so far that candidates would be proposed or verified otherwise."""
    motion = se3.log(product(se3.inverse(before), after))
    return bool((np.linalg.norm(motion[:, :3], axis=1) > SETTLED_M).any() or (np.linalg.norm(motion[:, 3:], axis=1) > SETTLED_RAD).any())


class LoopCloser:
    """Changes a map so that places seen again coincide; `fate` says of every pair of key frames that was tried what became of it."""

    def __init__(
        self,
        sparse_map: SparseMap,
        words: Words,
        frames: FrameStore,
        settings: LoopConfig,
        rng: np.random.Generator,
        objections: Objections = NO_OBJECTIONS,
    ) -> None:
        """Take the map with the words and frames of the recording that it is of."""
        self._sparse_map, self._words, self._frames, self._settings, self._rng = sparse_map, words, frames, settings, rng
        self._objections = objections
        self._places = PlaceIndex(words, sparse_map.kf.frame)
        self.fate: dict[tuple[int, int], Candidate] = {}

    def close_loops(self, progress: Callable[..., Iterable]) -> list[Candidate]:
        """Join segments, then search, verify and correct while that brings new closures. Returns all candidates with their fate.

        progress : wraps the candidates while they are verified
        """
        self.join_segments()
        for _ in range(self._settings.rounds):
            closures, T_wk = self._verify(progress(self._propose(), "loop")), self._sparse_map.kf.T_wk.copy()
            kept = self._correct(closures) if closures else []
            if not kept:
                break
            is_last = len(kept) == len(closures) and not has_moved(T_wk, self._sparse_map.kf.T_wk)
            self._fuse_and_adjust(kept, is_last=is_last)
            if is_last:
                break
        return [self.fate[pair] for pair in sorted(self.fate)]

    def join_segments(self) -> None:
        """Join map segments that saw the same place."""
        if len(np.unique(self._sparse_map.kf.segment)) < 2:
            return
        tried = [self._verified(c) for c in find_alike(self._sparse_map, self._places, self._settings) if self._is_between_segments(c)]
        left = [c for c in tried if c.is_accepted]
        self._note(c for c in tried if not c.is_accepted)
        refused: list[Join] = []
        while found := map_merging.find_join(self._sparse_map, left, least=self._settings.join_closures, refused=refused):
            if reason := self._objections.to_join(found):
                refused.append(found)
                claims = {(c.kf_i, c.kf_j) for c in found.closures}
                self._note(c.rejected(reason) for c in found.closures)
                left = [c for c in left if (c.kf_i, c.kf_j) not in claims]
                continue
            map_merging.join(self._sparse_map, found)
            self._fuse_and_adjust(first_of_each_revisit(found.closures, span=self._settings.closure_spacing))
            self._note(found.closures)
            # What says otherwise is tried again like any loop, now that odometry of a kind runs between the segments.
            left = [c for c in left if self._is_between_segments(c)]
        alone = f"closures between the two map segments are fewer than {self._settings.join_closures}, or others contradict it"
        self._note(c.rejected(alone) for c in left)

    def _propose(self) -> list[Candidate]:
        candidates = find_alike(self._sparse_map, self._places, self._settings)
        candidates += find_by_pose(self._sparse_map, self._places, self._settings)
        return [c for c in candidates if not self._is_between_segments(c)]

    def _verify(self, candidates: Iterable[Candidate]) -> list[Candidate]:
        """Verify the candidates that claim no revisit decided before, and note what becomes of them; returns those accepted."""
        span, fates = self._settings.closure_spacing, self.fate.values()
        closed = Claims((c for c in fates if c.is_accepted), span=span)
        contradicted = Claims((c for c in fates if not c.is_accepted and c.T_ij is not None), span=span)
        accepted = []
        for candidate in candidates:
            if self._is_settled(candidate, closed, contradicted):
                continue
            verified = self._verified(candidate)
            if verified.is_accepted and (reason := self._objections.to_closure(verified)):
                verified = verified.rejected(reason)
            self._note([verified])
            if verified.is_accepted:
                accepted.append(verified)
                closed.add(verified)
        return accepted

    def _is_settled(self, candidate: Candidate, closed: Claims, contradicted: Claims) -> bool:
        """Say whether a candidate need not be verified, as that of its revisit is decided; its fate stays what it was."""
        if closed.cover(candidate):
            return True  # one closure joins its whole neighbourhood: fusion finds the rest
        if candidate.is_by_pose:
            return False  # what the present poses name is another idea than what words named before
        # Where the graph contradicted one, words would only name its like again.
        return contradicted.cover(candidate) or self._matches_too_little(candidate)

    def _matches_too_little(self, candidate: Candidate) -> bool:
        """Say whether a pair that its words propose was tried before and had too few matches: these do not depend on the map."""
        before = self.fate.get((candidate.kf_i, candidate.kf_j))
        return before is not None and not before.is_by_pose and before.n_matches < self._settings.min_matches

    def _correct(self, closures: list[Candidate]) -> list[Candidate]:
        """Solve the pose graph with new closures and move the map; returns those that the rest of the graph does not contradict."""
        graph = loop_pose_graph.solve(self._sparse_map, closures, self._settings)
        is_kept, chi2 = graph.is_kept[-len(closures) :], graph.chi2[-len(closures) :]
        dropped = zip(itertools.compress(closures, ~is_kept), chi2[~is_kept], strict=True)
        self._note(c.rejected(f"the pose graph contradicts it (chi2 {value:.0f})") for c, value in dropped)
        if is_kept.any():
            loop_pose_graph.move(self._sparse_map, graph.T_wk)
        return list(itertools.compress(closures, is_kept))

    def _fuse_and_adjust(self, closures: list[Candidate], *, is_last: bool = False) -> None:
        """Fuse what both sides of the closures see, and adjust the whole map.

        Where the final refinement is to follow, the map is adjusted coarsely, and after the last round not at all.
        """
        sparse_map = self._sparse_map
        for closure in closures:
            self._fuse_around(closure)
        sparse_map.refresh(np.flatnonzero(sparse_map.lm.is_alive).astype(np.int32))
        if is_last and self._settings.final_refinement:
            return
        kfs, most = np.arange(len(sparse_map.kf), dtype=np.int32), self._settings.iterations
        tolerance = map_adjustment.NEARLY if self._settings.final_refinement else map_adjustment.CONVERGED
        map_adjustment.adjust(sparse_map, kfs, self._frames.camera, self._frames.sensor, max_iterations=most, tolerance=tolerance)

    def _fuse_around(self, closure: Candidate) -> None:
        """Find the landmarks of each side in the key frames of the other side."""
        sides = []
        for kf in (closure.kf_i, closure.kf_j):
            neighbours, shared = self._sparse_map.covisible(kf)
            sides.append(np.append(neighbours[shared >= self._settings.edge_shared][: self._settings.neighbours], kf))
        for here, there in (sides, sides[::-1]):
            for kf in here:
                landmarks, most = self._sparse_map.landmarks_in(there), self._settings.fuse_max_distance
                fuse_landmarks(self._sparse_map, int(kf), landmarks, self._frames, max_distance=most)

    def _verified(self, candidate: Candidate) -> Candidate:
        return verify(self._sparse_map, self._words, candidate, self._frames, self._settings, self._rng)

    def _is_between_segments(self, c: Candidate) -> bool:
        segment = self._sparse_map.kf.segment
        return bool(segment[c.kf_i] != segment[c.kf_j])

    def _note(self, candidates: Iterable[Candidate]) -> None:
        self.fate.update({(c.kf_i, c.kf_j): c for c in candidates})
