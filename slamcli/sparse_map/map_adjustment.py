"""Bundle adjustment of a part of the growing map, or of all of it."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.depth import noise_model
from slamcli.estimation import bundle_adjustment
from slamcli.estimation.bundle_problem import Observations, Problem, Variables
from slamcli.estimation.measurements import Measurements
from slamcli.estimation.relative_pose_factors import NO_EDGES, Edges
from slamcli.geometry import depth_noise, se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.schema import Features
from slamcli.sparse_map.sparse_map import SparseMap

CONVERGED, NEARLY = 1e-5, 1e-3  # share of the cost that an iteration lowers it by: at the optimum; where another adjustment follows


def measure(features: Features, rows: np.ndarray | slice, sensor: SensorConfig) -> Measurements:
    """Look up the measurements of feature `rows` (indices or a slice) with their standard deviations."""
    depth = np.array(features.depth[rows], dtype=np.float64)
    with np.errstate(invalid="ignore"):
        np.copyto(depth, np.nan, where=~((depth >= sensor.depth_min) & (depth <= sensor.depth_max)))
    return Measurements(
        xy=np.array(features.xy[rows], dtype=np.float64),
        depth=depth,
        sigma_px=_sigma_of_octave(sensor.pixel_noise, float(features.octave_scale)).take(features.octave[rows]),
        sigma_z=depth_noise.sigmas(depth, noise_model.depth_noise(sensor)),
    )


@lru_cache(maxsize=4)
def _sigma_of_octave(pixel_noise: float, octave_scale: float) -> np.ndarray:
    """Tabulate the standard deviation [px] of key points by their octave, for every value that it can be stored as."""
    with np.errstate(over="ignore"):
        return noise_model.pixel_sigma(np.arange(256), pixel_noise=pixel_noise, octave_scale=octave_scale)


@dataclass(frozen=True)
class MapPart:
    """A part of the map as bundle adjustment takes it."""

    kfs: np.ndarray  # (K,) key frames that take part, increasing
    is_fixed: np.ndarray  # (K,) bool
    ids: np.ndarray  # (L,) landmarks seen more than once
    singles: np.ndarray  # landmarks seen once: they bear on nothing and go along with their key frame
    row: np.ndarray  # (O,) feature row of each observation
    seen: Observations  # by index into kfs and ids
    edges: Edges  # between key frames of kfs

    def start(self, sparse_map: SparseMap) -> Variables:
        """Return its key frames and landmarks as they stand in the map."""
        return Variables(sparse_map.T_kw(self.kfs), sparse_map.lm.xyz[self.ids])


def gather(sparse_map: SparseMap, moving: np.ndarray, sensor: SensorConfig) -> MapPart:
    """Gather the key frames `moving` and all they see; key frames outside that see the same, or that edges join to them, are held fixed.

    In a segment where none is held so, the oldest of `moving` is, which fixes the gauge.
    """
    ids = sparse_map.landmarks_in(moving)
    is_single = sparse_map.lm.n_obs[ids] < 2
    shared = ids[~is_single]
    obs_lm, obs_kf, row = sparse_map.observations_of(shared)
    kfs = np.union1d(np.union1d(moving, obs_kf), sparse_map.joined_by_edges(moving))
    is_fixed = ~np.isin(kfs, moving)
    segments, oldest = np.unique(sparse_map.kf.segment[kfs], return_index=True)
    is_fixed[oldest[~np.isin(segments, sparse_map.kf.segment[kfs[is_fixed]])]] = True
    kf_index = np.searchsorted(kfs, obs_kf).astype(np.int32)
    is_inside = np.isin(sparse_map.edge.kf, kfs).all(axis=1) & np.isin(sparse_map.edge.kf, moving).any(axis=1)
    edges = Edges(
        np.searchsorted(kfs, sparse_map.edge.kf[is_inside]), sparse_map.edge.T_ij[is_inside], sparse_map.edge.information[is_inside]
    )
    measured = measure(sparse_map.features, row, sensor)
    seen = Observations(kf_index, obs_lm, measured.xy, measured.depth, measured.sigma_px, measured.sigma_z)
    return MapPart(kfs, is_fixed, shared, ids[is_single], row, seen, edges)


def landmarks_alone(part: MapPart, first: int, end: int) -> MapPart:
    """Return the landmarks that key frames `first` to `end`, the last left out, see more than once, without edges between key frames."""
    is_in = (part.kfs >= first) & (part.kfs < end)
    index, old_lm = np.cumsum(is_in) - 1, np.asarray(part.seen.lm)
    is_used = is_in[part.seen.kf]
    is_used &= np.bincount(old_lm[is_used], minlength=len(part.ids))[old_lm] > 1
    ids, lm = np.unique(old_lm[is_used], return_inverse=True)
    columns = (column[is_used] for column in (part.seen.xy, part.seen.depth, part.seen.sigma_px, part.seen.sigma_z))
    seen = Observations(index[part.seen.kf[is_used]].astype(np.int32), lm, *columns)
    kfs, is_fixed = part.kfs[is_in], part.is_fixed[is_in].copy()
    is_fixed[:1] = True
    return MapPart(kfs, is_fixed, part.ids[ids], part.singles[:0], part.row[is_used], seen, NO_EDGES)


def adjust(
    sparse_map: SparseMap,
    moving: np.ndarray,
    camera: Camera,
    sensor: SensorConfig,
    *,
    max_iterations: int,
    edge_weight: float = 1.0,
    tolerance: float = CONVERGED,
) -> bundle_adjustment.BundleResult | None:
    """Adjust the key frames `moving` and all they see, in place, and remove the observations found to be outliers.

    edge_weight : factor on the information of edges between key frames
    tolerance : share of the cost; an iteration that lowers it by less ends the adjustment
    Returns the evidence, or None where nothing ties two key frames together.
    """
    part = gather(sparse_map, moving, sensor)
    if len(part.row) == 0 and len(part.edges) == 0:
        return None
    edges = replace(part.edges, information=edge_weight * part.edges.information)
    problem = Problem(part.start(sparse_map), part.seen, camera, is_fixed=part.is_fixed, edges=edges)
    result = bundle_adjustment.adjust(problem, max_iterations=max_iterations, tolerance=tolerance)
    before = sparse_map.kf.T_wk[part.kfs].copy()
    sparse_map.kf.T_wk[part.kfs[~part.is_fixed]] = se3.inverse(result.T_cw[~part.is_fixed])
    sparse_map.lm.xyz[part.ids] = result.x_w
    carry(sparse_map, part.singles, part.kfs, before)
    sparse_map.remove_observations(part.row[~result.is_inlier])
    return result


def carry(sparse_map: SparseMap, ids: np.ndarray, kfs: np.ndarray, T_wk_before: np.ndarray) -> None:
    """Move landmarks `ids` rigidly with the key frame that created them, from the poses `T_wk_before` of `kfs` (sorted) to those of now."""
    of = np.searchsorted(kfs, sparse_map.lm.first_kf[ids])
    is_known = (of < len(kfs)) & (kfs[np.minimum(of, len(kfs) - 1)] == sparse_map.lm.first_kf[ids])
    ids, of = ids[is_known], of[is_known]
    motion = product(sparse_map.kf.T_wk[kfs], se3.inverse(T_wk_before))
    sparse_map.lm.xyz[ids] = np.einsum("nij,nj->ni", motion[of, :3, :3], sparse_map.lm.xyz[ids]) + motion[of, :3, 3]
