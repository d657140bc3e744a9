"""Relocalization: a frame without a predecessor is recognized by its words and placed in a key frame that looks like it; [Z] (10)."""

import numpy as np

from slamcli.config.options import TrackConfig
from slamcli.estimation import camera_pose
from slamcli.estimation.camera_pose import Ransac
from slamcli.schema import Words
from slamcli.slam.place_recognition import PlaceIndex, bow_vector
from slamcli.sparse_map import landmark_pose
from slamcli.sparse_map.guided_matching import FrameFeatures
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.vision import hamming

MORE_ROUNDS = 3  # times the rounds of RANSAC between neighbouring frames: fewer of the matches are true


class Relocalizer:
    """Finds frames in the map by their bags of words."""

    def __init__(self, sparse_map: SparseMap, places: PlaceIndex, words: Words, settings: TrackConfig, rng: np.random.Generator) -> None:
        """Take the map with the index of its key frames, and the words of the recording whose frames are looked for."""
        self._sparse_map, self._places, self._words = sparse_map, places, words
        self._settings, self._rng = settings, rng

    def find(self, i: int, frame: FrameFeatures) -> tuple[np.ndarray, np.ndarray] | None:
        """Find T_cw (4, 4) of frame `i` and the landmarks (N,) that it shows in the likest key frame that agrees; None where none does."""
        kfs, scores = self._places.query(bow_vector(self._words, i))
        for kf in kfs[np.argsort(-scores, kind="stable")[: self._settings.relocalize_candidates]]:
            row, ids = self._match_key_frame(int(kf), frame)
            if len(row) < self._settings.min_inliers:
                continue
            x_w = self._sparse_map.lm.xyz[ids]
            ransac = Ransac(MORE_ROUNDS * self._settings.ransac_rounds, self._settings.ransac_threshold_px)
            start = camera_pose.ransac_p3p(x_w, frame.xy[row], frame.camera, rng=self._rng, ransac=ransac)
            if start is None:
                continue
            estimate = landmark_pose.refine(start.T_cw, x_w, frame, row)
            if estimate.n_inliers >= self._settings.min_inliers:
                return estimate.T_cw, ids[estimate.is_inlier]
        return None

    def _match_key_frame(self, kf: int, frame: FrameFeatures) -> tuple[np.ndarray, np.ndarray]:
        """Match the frame with the landmarks of a key frame under the same vocabulary nodes; returns its features and the landmarks."""
        there = self._sparse_map.rows_of(kf)
        here = slice(frame.first_row, frame.first_row + len(frame))
        features = self._sparse_map.features
        match, _ = hamming.match_nodes(
            hamming.Described(frame.desc.view(np.uint8), frame.angle, self._words.node(here)),
            hamming.Described(features.desc[there], features.angle[there], self._places.words.node(there)),
        )
        ids = self._sparse_map.lm_of_row[there][match[:, 1]]
        return match[ids >= 0, 0], ids[ids >= 0]
