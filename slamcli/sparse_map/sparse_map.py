"""The growing map: key frames, landmarks and observations. The only mutable store of the tracker."""

import numpy as np

from slamcli import mapped_memory
from slamcli.geometry import elementary, se3
from slamcli.schema import Features, Map, check_seen_in
from slamcli.sparse_map import observation_chains
from slamcli.sparse_map.guided_matching import Landmarks
from slamcli.sparse_map.observation_chains import Chains, Fates, FeatureColumns, Looks
from slamcli.sparse_map.table import Table


class SparseMap:
    """Key frames and landmarks with their observations, as flat tables.

    A landmark's observations form a chain (`observation_chains`). `lm_of_row` answers the other question: which landmark a feature of a
    key frame shows.
    """

    def __init__(self, features: Features):
        self.features = features
        self.desc = np.ascontiguousarray(features.desc).view(np.uint64)
        self.octave = np.ascontiguousarray(features.octave)
        self._offset = np.array(features.offset, dtype=np.int64)
        self.octave_scale = float(features.octave_scale)
        self.kf = Table(
            frame=("i4",),
            segment=("i4",),  # of the map, each with a world frame of its own
            T_wk=("f8", 4, 4),  # key frame to world
        )
        self.lm = Table(
            xyz=("f8", 3),  # m, world
            desc=("u8", 4),  # of the observation nearest to all others, 256 bits
            direction=("f8", 3),  # mean unit vector from the key frames that saw it
            reach=("f8",),  # m, distance at which it appears at octave 0
            head=("i4",),  # its first row in `obs`
            n_obs=("i4",),  # key frames that observe it
            n_visible=("i4",),  # frames that should have seen it
            n_found=("i4",),  # frames that did
            first_kf=("i4",),  # key frame that created it
            replaced_by=("i4",),  # landmark that it was fused into, -1 = none
            is_alive=("?",),
        )
        self.obs = Table(
            lm=("i4",),
            kf=("i4",),  # -1 = removed
            row=("i8",),  # in the table of all features
            next=("i4",),  # of the same landmark, -1 = none
        )
        self.edge = Table(
            kf=("i4", 2),  # i, j
            T_ij=("f8", 4, 4),  # measured by depth ICP: x_i = T_ij x_j
            information=("f8", 6, 6),  # of its left twist (rho, phi) [1/m^2, 1/rad^2]
        )
        self.lm_of_row = mapped_memory.by_blocks(lambda rows: np.array(-1), int(features.offset[-1]), (), np.int32)

    def add_key_frame(self, frame: int, T_wk: np.ndarray, segment: int = 0) -> int:
        """Add a key frame without observations; returns its row."""
        # Its pose often comes from that of the key frame before, by products and inverses that double the rounding each time.
        return self.kf.append(1, frame=frame, segment=segment, T_wk=se3.orthonormalize(T_wk)).start

    def add_landmarks(self, kf: int, rows: np.ndarray, xyz: np.ndarray) -> np.ndarray:
        """Create landmarks at `xyz` (N, 3) [m, world], each seen by key frame `kf` as feature `rows` (N,); returns their ids."""
        centre = self.kf.T_wk[kf, :3, 3]
        sight = xyz - centre
        distance = np.linalg.norm(sight, axis=1)
        added = self.lm.append(
            len(rows),
            xyz=xyz,
            desc=self.desc[rows],
            direction=sight / distance[:, None],
            reach=distance * elementary.power(self.octave_scale, self.octave[rows]),
            head=-1,
            n_obs=0,
            n_visible=1,
            n_found=1,
            first_kf=kf,
            replaced_by=-1,
            is_alive=True,
        )
        ids = np.arange(added.start, added.stop, dtype=np.int32)
        self.observe(kf, ids, rows)
        return ids

    def observe(self, kf: int, ids: np.ndarray, rows: np.ndarray) -> None:
        """Note that key frame `kf` sees landmarks `ids` (N,) as features `rows` (N,); neither may be in use in `kf` already."""
        added = self.obs.append(len(ids), lm=ids, kf=kf, row=rows, next=-1)
        observation_chains.link(self._chains(), added.start)
        self.lm_of_row[rows] = ids

    def add_edge(self, kf_i: int, kf_j: int, T_ij: np.ndarray, information: np.ndarray) -> None:
        """Add a measured relative pose of two key frames, ``x_i = T_ij @ x_j``; information (6, 6) of the left twist of T_ij."""
        self.edge.append(1, kf=(kf_i, kf_j), T_ij=T_ij, information=information)

    def joined_by_edges(self, kfs: np.ndarray) -> np.ndarray:
        """Return the key frames (N,) that edges join to any of `kfs`, these themselves left out, increasing."""
        touches = np.isin(self.edge.kf, kfs)
        return np.setdiff1d(self.edge.kf[touches.any(axis=1)], kfs).astype(np.int32)

    def rows_of(self, kf: int) -> slice:
        """Return the feature rows of a key frame."""
        offset = self.features.offset
        frame = self.kf.frame[kf]
        return slice(int(offset[frame]), int(offset[frame + 1]))

    def resolve(self, ids: np.ndarray) -> np.ndarray:
        """Follow landmarks (N,) to those they were fused into; -1 for none and for the dead."""
        ids = np.array(ids, dtype=np.int32)
        while True:
            moved = (ids >= 0) & (self.lm.replaced_by[ids] >= 0)
            if not moved.any():
                break
            ids[moved] = self.lm.replaced_by[ids[moved]]
        ids[(ids >= 0) & ~self.lm.is_alive[ids]] = -1
        return ids

    def votes(self, ids: np.ndarray) -> np.ndarray:
        """Count for every key frame (K,) how many of the landmarks `ids` it sees."""
        counts = np.zeros(len(self.kf), dtype=np.int32)
        observation_chains.count_views(ids, self._chains(), counts)
        return counts

    def landmarks_in(self, kfs: np.ndarray) -> np.ndarray:
        """Return the landmarks (N,) that any of the key frames sees, increasing."""
        is_seen, frame = np.zeros(len(self.lm), dtype=np.bool_), self.kf.frame[kfs]
        observation_chains.mark(self._offset[frame], self._offset[frame + 1], self.lm_of_row, is_seen)
        return np.flatnonzero(is_seen).astype(np.int32)

    def landmarks_of(self, kf: int) -> np.ndarray:
        """Return the landmarks (N,) of one key frame in the order of its features."""
        ids = self.lm_of_row[self.rows_of(kf)]
        return ids[ids >= 0]

    def covisible(self, kf: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the key frames that share landmarks with `kf`, most first, and how many they share."""
        counts = self.votes(self.landmarks_of(kf))
        counts[kf] = 0
        order = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
        return order.astype(np.int32), counts[order]

    def landmarks(self, ids: np.ndarray) -> Landmarks:
        """Return landmarks in the form that guided matching takes."""
        xyz, desc, direction, reach = (column.take(ids, axis=0) for column in (self.lm.xyz, self.lm.desc, self.lm.direction, self.lm.reach))
        return Landmarks(xyz, desc, direction, reach, self.octave_scale)

    def observations_of(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return all observations of landmarks `ids`: index into `ids`, key frame, feature row; sorted by (landmark, key frame)."""
        total = int(self.lm.n_obs[ids].sum())
        which, kf, row = np.empty(total, np.int32), np.empty(total, np.int32), np.empty(total, np.int64)
        n = observation_chains.gather(ids, self._chains(), which, kf, row)
        assert n == total
        return which, kf, row

    def remove_observations(self, rows: np.ndarray) -> None:
        """Forget that the features `rows` (N,) of key frames show their landmarks; a landmark without views dies."""
        observation_chains.unlink(rows, self.lm_of_row, self.lm.is_alive, self._chains())

    def remove_landmarks(self, ids: np.ndarray) -> None:
        """Remove landmarks with all their observations."""
        _, _, rows = self.observations_of(ids)
        self.remove_observations(rows)
        self.lm.is_alive[ids] = False

    def fuse(self, kept: np.ndarray, gone: np.ndarray) -> None:
        """Merge landmarks `gone` (N,) into `kept` (N,), in this order: their views move over, save where a key frame sees the other already.

        A pair one of which is dead, or died by a fusion before it, is passed over.
        """
        pairs = (np.ascontiguousarray(ids, dtype=np.int32) for ids in (kept, gone))
        fates = Fates(self.lm.n_visible, self.lm.n_found, self.lm.is_alive, self.lm.replaced_by)
        observation_chains.fuse(*pairs, self.lm_of_row, fates, self._chains())

    def refresh(self, ids: np.ndarray) -> None:
        """Recompute what guided matching needs of landmarks `ids`: descriptor, viewing direction, reach."""
        features = FeatureColumns(self.desc, self.octave, self.octave_scale)
        looks = Looks(self.lm.desc, self.lm.direction, self.lm.reach)
        observation_chains.refresh(ids, self._chains(), self.lm.xyz, self.kf.T_wk, features, looks)

    def snapshot(self) -> Map:
        """Return the map as an artefact: living landmarks, renumbered."""
        ids = np.flatnonzero(self.lm.is_alive & (self.lm.n_obs > 0)).astype(np.int32)
        which, kf, row = self.observations_of(ids)
        return Map(
            kf_frame=self.kf.frame.copy(),
            kf_segment=self.kf.segment.copy(),
            T_wk=self.kf.T_wk.copy(),
            lm_xyz=self.lm.xyz[ids],
            obs_lm=which,
            obs_kf=kf,
            obs_row=row,
            edge_kf=self.edge.kf.copy(),
            edge_T_ij=self.edge.T_ij.copy(),
            edge_information=self.edge.information.copy(),
        )

    @classmethod
    def from_map(cls, features: Features, map_: Map) -> "SparseMap":
        """Rebuild the growing form of a map; SlamError where it rests on other features."""
        check_seen_in(map_, features)
        self = cls(features)
        n_kf, n_lm = len(map_.kf_frame), len(map_.lm_xyz)
        self.kf.append(n_kf, frame=map_.kf_frame, segment=map_.kf_segment, T_wk=map_.T_wk)
        first = np.searchsorted(map_.obs_lm, np.arange(n_lm))
        first_kf = map_.obs_kf[first] if n_lm else np.empty(0, np.int32)
        self.lm.append(
            n_lm,
            xyz=map_.lm_xyz,
            desc=0,
            direction=0.0,
            reach=0.0,
            head=-1,
            n_obs=0,
            n_visible=1,
            n_found=1,
            first_kf=first_kf,
            replaced_by=-1,
            is_alive=True,
        )
        self.obs.append(len(map_.obs_lm), lm=map_.obs_lm, kf=map_.obs_kf, row=map_.obs_row, next=-1)
        observation_chains.link(self._chains(), 0)
        self.lm_of_row[map_.obs_row] = map_.obs_lm
        self.edge.append(len(map_.edge_kf), kf=map_.edge_kf, T_ij=map_.edge_T_ij, information=map_.edge_information)
        self.refresh(np.arange(n_lm, dtype=np.int32))
        return self

    def _chains(self) -> Chains:
        return Chains(self.lm.head, self.lm.n_obs, self.obs.next, self.obs.lm, self.obs.kf, self.obs.row)

    def centres(self) -> np.ndarray:
        """Return the camera centres (K, 3) of the key frames [m, world]."""
        return self.kf.T_wk[:, :3, 3]

    def T_kw(self, kfs: np.ndarray) -> np.ndarray:
        """Return world-to-camera transforms (N, 4, 4) of key frames."""
        return se3.inverse(self.kf.T_wk[kfs])
