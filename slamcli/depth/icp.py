"""Depth ICP: where the picture has no texture, the surfaces that two depth images show say how the camera moved.

Depth images are made coarse, as surfaces need no fine detail and the noise of single readings averages out. Points of one meet the point of
the other that they project to, and their distance along its normal is minimized (Y. Chen, G. Medioni, Object Modelling by Registration of
Multiple Range Images, 1992, doi:10.1016/0262-8856(92)90066-C; projective association: G. Blais, M. Levine, PAMI 1995,
doi:10.1109/34.400574).

Depth does not always tell: over one plane a camera may shift in two directions and turn about the normal without any change. What is
determined is read from the information matrix.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from slamcli.config.options import SensorConfig, SurfaceConfig
from slamcli.depth import icp_kernels as kernels
from slamcli.depth import noise_model, oriented_points
from slamcli.depth.icp_kernels import AgreementRule, PointImage, Points, PoseEquations
from slamcli.geometry import depth_noise, se3
from slamcli.geometry.algebra import eigh, product
from slamcli.geometry.camera import Camera

COLUMNS = 160  # of a coarse depth image, at least
UNIT = 2e-4  # [m] of the numbers that coarse depth is kept in
CLEANING = SurfaceConfig(edge=1, window=1.0, max_angle_deg=75.0)
MIN_COSINE = 0.8  # between the normals of points that meet
HUBER_CHI2 = 4.0
# Readings err together, by the sensor's correlation window, its steps of disparity and its warp: so many count as one. With 500, chi2 of
# the motion found is 0.3 for a simulated Kinect, whose readings hardly do, and 50 on fr1_xyz: it should be 6.
READINGS_AS_ONE = 500.0
# [m, rad] how far the start is believed to be off: next to nothing beside what depth says, and all there is where it says nothing.
START_SIGMA = np.array([0.2, 0.2, 0.2, 0.2, 0.2, 0.2])
DIRECTIONS = 6  # of motion
DETERMINED_SIGMA = 0.01  # [m] a direction known to this at the mean depth is determined; noise alone feigns 0.015 to 0.03 over planes
RULE = AgreementRule(MIN_COSINE, HUBER_CHI2, READINGS_AS_ONE)


class Pass(NamedTuple):
    """One pass of an alignment, from coarse to fine."""

    every: float  # n-th point takes part
    reach: float  # [m] that points which meet may be apart
    iterations: float  # at most
    least_step: float  # of the motion's twist [m, rad]: a shorter one ends the pass


SCHEDULE = np.array([Pass(8, 0.3, 8, 1e-3), Pass(4, 0.12, 6, 5e-4), Pass(1, 0.06, 4, 2e-4)])


@dataclass(frozen=True)
class PosePrior:
    """What is known of a pose besides what depth says, such as landmarks give."""

    T: np.ndarray  # (4, 4)
    information: np.ndarray  # (6, 6) of its left twist (rho, phi) [1/m^2, 1/rad^2]


@dataclass(frozen=True)
class OrientedPoints:
    """The surface that a coarse depth image shows, as points with normals."""

    xyz: np.ndarray  # (N, 3) float32 [m], camera frame
    normal: np.ndarray  # (N, 3) float32, unit, towards the camera
    variance: np.ndarray  # (N,) float32 [m^2], of a reading along the ray
    row: np.ndarray  # (h, w) int32, the point seen by each pixel of a pinhole camera without distortion, -1 = none
    pinhole: np.ndarray  # (4,) its fx, fy, cx, cy [px]

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def points(self) -> Points:
        """Return the points as the kernels take them."""
        return Points(self.xyz, self.normal, self.variance)

    @property
    def view(self) -> PointImage:
        """Return which point each pixel shows, as the kernels take it."""
        return PointImage(self.row, self.pinhole)


@dataclass(frozen=True)
class Alignment:
    """A relative pose by depth ICP and the evidence for it."""

    T_ij: np.ndarray  # (4, 4), x_i = T_ij x_j
    information: np.ndarray  # (6, 6) of the left twist (rho, phi) of T_ij [1/m^2, 1/rad^2]
    overlap: float  # share of the points of j that meet and agree with one of i
    agreement: float  # share of those that meet that agree
    rms: float  # of the residuals in sigma
    depth: float  # [m] mean of the points of j
    iterations: int  # of all passes
    is_converged: bool  # whether the last pass ended by a step that was short enough, not by the number of its iterations


def _blocks(columns: int) -> tuple[int, int, int]:
    """Return the side [px] of the blocks that stand for one coarse pixel, and the first row and the width of the part that is averaged.

    Readings err together with their neighbours: the middle of a block tells nearly as much as all of it, in a third of the time.
    """
    side = max(1, columns // COLUMNS)
    width = (side + 1) // 2
    return side, (side - width) // 2, width


def coarsen(depth: np.ndarray) -> np.ndarray:
    """Make a depth image (H, W) float32 [m] coarse: (H // side, W // side) uint16 in UNIT, 0 = none."""
    side, first, width = _blocks(depth.shape[1])
    out = np.empty((depth.shape[0] // side, depth.shape[1] // side), dtype=np.float32)
    kernels.window_means(np.ascontiguousarray(depth, dtype=np.float32), side, first, width, out)
    scaled = np.rint(out * np.float32(1.0 / UNIT))
    return np.where(scaled <= np.iinfo(np.uint16).max, scaled, 0).astype(np.uint16)  # NaN compares false


def coarse_shape(camera: Camera) -> tuple[int, int]:
    """Return the rows and columns of the camera's coarse depth images."""
    side, _, _ = _blocks(camera.width)
    return camera.height // side, camera.width // side


def surface_points(coarse_depth: np.ndarray, camera: Camera, sensor: SensorConfig, *, given: Camera | None = None) -> OrientedPoints:
    """Find the surface in a coarse depth image of `camera`.

    given : the calibration under which the depth was read, if it was another one
    """
    small, row_at = coarse_camera(camera)
    depth = camera.reread(coarse_depth.astype(np.float32) * np.float32(UNIT), given or camera)
    seen = oriented_points.surface(depth, small, settings=CLEANING, sensor=sensor, stride=1, spacing=0.0)
    row = np.full(depth.size + 1, -1, dtype=np.int32)
    row[seen.pixel] = np.arange(len(seen.pixel), dtype=np.int32)
    return OrientedPoints(
        xyz=seen.xyz_c,
        normal=seen.normal_c,
        variance=np.square(depth_noise.sigmas(seen.xyz_c[:, 2], noise_model.reading_noise(sensor))).astype(np.float32),
        row=row[row_at],
        pinhole=np.array([small.fx, small.fy, small.cx, small.cy]),
    )


@lru_cache(maxsize=4)
def coarse_camera(camera: Camera) -> tuple[Camera, np.ndarray]:
    """Return the camera of the coarse images, and which of its raw pixels each pixel of it without distortion shows (h, w), last = none."""
    side, first, width = _blocks(camera.width)
    middle = first + (width - 1) / 2
    values = camera.to_dict() | {"width": camera.width // side, "height": camera.height // side}
    values |= {"fx": camera.fx / side, "fy": camera.fy / side}
    values |= {name: (values[name] - middle) / side for name in ("cx", "cy")}
    small = Camera(**values)
    v, u = np.mgrid[0 : small.height, 0 : small.width]
    raw = np.rint(small.distort(np.stack([u, v], axis=-1).astype(np.float64))).astype(np.int64)
    inside = ((raw >= 0) & (raw < [small.width, small.height])).all(axis=-1)
    return small, np.where(inside, raw[..., 1] * small.width + raw[..., 0], small.width * small.height)


def align(T_ij: np.ndarray, source: OrientedPoints, target: OrientedPoints, *, prior: PosePrior | None = None) -> Alignment:
    """Move the points of `source` (j) onto the surface of `target` (i), from the start T_ij.

    prior : what else is known of T_ij
    """
    T = np.array(T_ij, dtype=np.float64, order="C")
    H_prior, b_prior = np.diag(1.0 / (START_SIGMA * START_SIGMA)), np.zeros(6)
    if prior is not None:
        H_prior = H_prior + prior.information
        b_prior = product(prior.information, se3.log(product(prior.T, se3.inverse(T))))
    found = PoseEquations(np.zeros((6, 6)), np.zeros(6))
    met, agree, cost, iterations, is_converged = kernels.align(
        T, source.points, target.points, target.view, SCHEDULE, RULE, PoseEquations(H_prior, b_prior), found
    )
    factor = READINGS_AS_ONE * max(cost / max(agree, 1), kernels.LEAST_VARIANCE_FACTOR)
    return Alignment(
        T_ij=se3.orthonormalize(T),
        information=(np.triu(found.H) + np.triu(found.H, 1).T) / factor,
        overlap=agree / max(len(source), 1),
        agreement=agree / max(met, 1),
        rms=float(np.sqrt(cost / max(agree, 1))),
        depth=float(source.xyz[:, 2].mean()) if len(source) else np.nan,
        iterations=iterations,
        is_converged=bool(is_converged),
    )


def weakest_sigmas(information: np.ndarray, depth: float) -> np.ndarray:
    """Return the standard deviations (6,) [m] along the principal directions of a motion, the worst first.

    information : (6, 6) of a twist [1/m^2, 1/rad^2]; depth : [m] of what is seen, where a turn by 1 rad moves things as far
    """
    scale = np.array([1.0, 1.0, 1.0, 1.0 / depth, 1.0 / depth, 1.0 / depth])
    values = eigh(scale[:, None] * information * scale)[0]
    return 1.0 / np.sqrt(np.maximum(values, 1e-12))


def n_determined(information: np.ndarray, depth: float) -> int:
    """Count the directions of motion, of 6, that are determined."""
    return int((weakest_sigmas(information, depth) < DETERMINED_SIGMA).sum()) if np.isfinite(depth) else 0
