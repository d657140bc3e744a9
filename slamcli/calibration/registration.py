"""What a map says of the place of a depth camera whose depth was registered to colour on reading.

Where the registration is wrong, depth is read beside its place: of a floor or a slanting wall that is another depth, and places seen
again from elsewhere contradict one another. A map at its optimum says by how much the depth camera would have to move to make its
residuals least (`estimation/shared_parameters.py`). What stretches all depth alike, as an offset ahead nearly does, it cannot tell.
"""

import numpy as np

from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import SensorConfig
from slamcli.estimation import shared_parameters
from slamcli.estimation.bundle_problem import Problem
from slamcli.estimation.robust_loss import LEAST_SQUARES
from slamcli.estimation.shared_parameters import SharedEvidence
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.geometry.depth_registration import Registration
from slamcli.sparse_map import map_adjustment
from slamcli.sparse_map.sparse_map import SparseMap

# The unknowns, in this order: logarithm of the focal length, principal point [px], rotation vector [rad] and translation [m] of T_cd.
N_UNKNOWNS = 9


def evidence(sparse_map: SparseMap, now: Sensing, sensor: SensorConfig, registration: Registration) -> SharedEvidence | None:
    """Gather what an adjusted map says of changes to its depth camera; None where the map is not determined."""
    n = len(sparse_map.kf)
    gathered = map_adjustment.gather(sparse_map, np.arange(n, dtype=np.int32), sensor)
    part = map_adjustment.landmarks_alone(gathered, 0, n)
    if len(part.row) == 0:
        return None
    problem = Problem(part.start(sparse_map), part.seen, now.camera, is_fixed=part.is_fixed, edges=part.edges, loss=LEAST_SQUARES)
    predicted = problem.in_given_order(problem.predict(problem.start))
    x_c = now.camera.backproject(predicted[:, :2], predicted[:, 2])
    columns = np.zeros((len(predicted), 3, N_UNKNOWNS))
    slope = np.asarray(sparse_map.features.slope[part.row], dtype=np.float64)
    columns[:, 2] = depth_derivatives(x_c, slope, now.camera, registration)
    return shared_parameters.evidence(problem, columns)


def depth_derivatives(x_c: np.ndarray, slope: np.ndarray, camera: Camera, registration: Registration) -> np.ndarray:
    """Return by how much registered depth [m] grows at fixed pixels of the colour camera per unit of each unknown, (N, 9).

    x_c : (N, 3) [m] what is seen there; slope : (N, 2) [1/m/px] growth of its inverse depth to the right and downwards
    A change moves what a reading shows: in depth, and aside, where a slanting surface is read at another of its places.
    """
    R, t, z = registration.T_cd[:3, :3], registration.T_cd[:3, 3], x_c[:, 2]
    arm = x_c - t
    x_d, none, per_px = product(arm, R), np.zeros_like(z), -z / registration.depth_camera.fx
    of_lens = ((-x_d[:, 0], -x_d[:, 1], none), (per_px, none, none), (none, per_px, none))
    moved = [product(np.stack(one, axis=1), R.T) for one in of_lens]
    moved += [np.cross(axis, arm) for axis in np.eye(3)]
    moved += [np.broadcast_to(axis, x_c.shape) for axis in np.eye(3)]
    columns = []
    for d in moved:
        du = camera.fx * (d[:, 0] - x_c[:, 0] / z * d[:, 2]) / z
        dv = camera.fy * (d[:, 1] - x_c[:, 1] / z * d[:, 2]) / z
        columns.append(d[:, 2] + z * z * (slope[:, 0] * du + slope[:, 1] * dv))
    return np.stack(columns, axis=1)
