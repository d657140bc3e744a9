"""Frames that too few landmarks hold are placed by depth ICP against the key frames around, together with the landmarks there are."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.depth import icp
from slamcli.depth.icp import PosePrior
from slamcli.geometry import se3
from slamcli.slam import background_prior
from slamcli.slam.depth_tracking import DepthAligner, DepthPlacement
from slamcli.slam.frame_poses import STEADY_INFORMATION, FramePoses
from slamcli.slam.local_map import LocalMap, MapMatch
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import SparseMap

SEARCH_KEY_FRAMES = 3  # around, that a frame is aligned with when its reference key frame does not do
FEW = 10  # landmarks that help depth; fewer are found anywhere
SEARCH_SECONDS = 2.0  # after so long without a pose, what looks like the depth around the last one may be any place


@dataclass(frozen=True)
class DepthMatch:
    """Where depth places a frame, and the landmarks that agree."""

    placement: DepthPlacement
    landmark: np.ndarray  # (N,) int32, of each feature of the frame, -1 = none
    is_anchored: bool  # whether every direction of motion was measured; else the frame before lent some


class DepthLocalizer:
    """Places frames by depth ICP, from the pose of the frame before."""

    def __init__(
        self,
        sparse_map: SparseMap,
        poses: FramePoses,
        aligner: DepthAligner,
        local_map: LocalMap,
        settings: TrackConfig,
        *,
        make_reference: Callable[[int], int | None],
    ) -> None:
        """Take the map, the poses so far, and what aligns depth images.

        make_reference : asked for a further key frame, nearer to frame i, where the reference of the frame before does not determine
            all directions of motion; it returns that key frame, None where there is none to be had
        """
        self._sparse_map, self._poses, self._aligner, self._local_map = sparse_map, poses, aligner, local_map
        self._settings, self._make_reference = settings, make_reference
        self._steady = background_prior.BETWEEN_FRAMES if poses.has_background else STEADY_INFORMATION

    def locate(self, i: int, frame: FrameFeatures, found: MapMatch | None) -> DepthMatch | None:
        """Align frame `i` with the reference key frame of the frame before it, together with what landmarks there are.

        found : the pose that landmarks give, if they give one
        Returns None where depth shows another place, or not enough to determine the pose; `lost_reason` then says which.
        """
        poses, stamp = self._poses, self._poses.stamp
        if poses.latest < 0 or stamp[i] - stamp[poses.latest] > SEARCH_SECONDS:
            return None
        expected = poses.predict(i, poses.latest, reach=np.inf)
        placed = self._search(i, frame, expected) if found is None else self._confirm(i, found)
        if placed is None or not placed.is_sound:
            return None
        is_anchored = placed.n_determined == icp.DIRECTIONS
        if not is_anchored:
            poses.lost_reason[i] = f"the depth shows {placed.n_determined} of {icp.DIRECTIONS} directions only: a flat wall"
            if found is not None or stamp[i] - stamp[poses.anchored] > self._settings.depth_icp_hold:
                return None
            placed = self._aligner.place(i, placed.kf, [expected], PosePrior(expected, self._steady))
            if placed is None or not placed.is_sound:
                return None
        few = self._match_few(frame, placed)
        landmark = np.full(len(frame), -1, dtype=np.int32) if few is None else few.landmark
        return DepthMatch(placed, landmark, is_anchored)

    def _confirm(self, i: int, found: MapMatch) -> DepthPlacement | None:
        """Align frame `i` from the pose that landmarks give, which counts as measured too."""
        estimate = found.estimate
        return self._aligner.place(
            i, int(self._poses.ref_kf[self._poses.latest]), [estimate.T_cw], PosePrior(estimate.T_cw, estimate.information)
        )

    def _search(self, i: int, frame: FrameFeatures, expected: np.ndarray) -> DepthPlacement | None:
        """Align frame `i` with one key frame after the other, until one determines its pose; else return the best placement.

        First the reference of the frame before, then a key frame made of that frame: it shows most of what frame `i` does, and the less
        two views part, the better a motion is determined. Then those around.
        """
        reference, segment = int(self._poses.ref_kf[self._poses.latest]), self._poses.segment(self._poses.latest)
        starts = [expected, se3.inverse(self._poses.T_wc(self._poses.latest))]
        best = self._place(i, frame, reference, starts, None)
        if not self._aligner.has_depth(i) or _is_determined(best):
            return best
        made = self._make_reference(i)
        if made is not None:
            best = self._place(i, frame, made, starts, best)
        around = self._aligner.around(se3.inverse(expected), segment)
        for kf in around[around != reference][:SEARCH_KEY_FRAMES].tolist():
            if _is_determined(best):
                break
            best = self._place(i, frame, kf, starts, best)
        return best

    def _place(self, i: int, frame: FrameFeatures, kf: int, starts: list[np.ndarray], best: DepthPlacement | None) -> DepthPlacement | None:
        """Align frame `i` with key frame `kf`, helped by landmarks where depth leaves directions open; returns the better of this and `best`.

        starts : T_cw, the first as expected, which counts as measured where the background's motion says so
        """
        placed = self._aligner.place(i, kf, starts, PosePrior(starts[0], self._steady) if self._poses.has_background else None)
        if placed is not None and placed.is_sound and placed.n_determined < icp.DIRECTIONS:
            few = self._match_few(frame, placed)
            if few is not None:
                placed = self._aligner.place(i, kf, [placed.T_cw], PosePrior(few.estimate.T_cw, few.estimate.information))
        is_better = placed is not None and placed.is_sound and (best is None or placed.n_determined > best.n_determined)
        return placed if is_better else best

    def _match_few(self, frame: FrameFeatures, placed: DepthPlacement) -> MapMatch | None:
        """Search the frame for the landmarks around the key frame it was aligned with; None where fewer than a few agree, or depth does not."""
        around = self._sparse_map.landmarks_in(np.append(self._sparse_map.joined_by_edges(np.array([placed.kf])), placed.kf))
        if len(around) == 0 or len(frame) < FEW:
            return None
        found = self._local_map.match(frame, placed.T_cw, around, wanted=FEW)
        return found if found is not None and placed.fits(found.estimate.T_cw) else None


def _is_determined(placed: DepthPlacement | None) -> bool:
    return placed is not None and placed.n_determined == icp.DIRECTIONS
