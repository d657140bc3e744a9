"""One frame's features in the form that matching against the map takes, and its pose refined on landmarks."""

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.estimation import camera_pose
from slamcli.estimation.camera_pose import PoseEstimate
from slamcli.geometry.camera import Camera
from slamcli.schema import Features
from slamcli.sparse_map import guided_matching, map_adjustment
from slamcli.sparse_map.guided_matching import FrameFeatures


def frame_features(features: Features, frame: int, camera: Camera, sensor: SensorConfig) -> FrameFeatures:
    """Gather the features of one frame with their noise, sorted into buckets of the image."""
    rows = slice(int(features.offset[frame]), int(features.offset[frame + 1]))
    measured = map_adjustment.measure(features, rows, sensor)
    xy = np.array(features.xy[rows])
    bucket_start, bucket_rows = guided_matching.sort_into_buckets(xy, camera)
    return FrameFeatures(
        xy=xy,
        depth=measured.depth,
        octave=np.array(features.octave[rows]),
        angle=np.array(features.angle[rows]),
        desc=np.array(features.desc[rows]).view(np.uint64),
        sigma_px=measured.sigma_px,
        sigma_z=measured.sigma_z,
        first_row=rows.start,
        bucket_start=bucket_start,
        bucket_rows=bucket_rows,
    )


def refine_on_landmarks(T_cw: np.ndarray, x_w: np.ndarray, frame: FrameFeatures, rows: np.ndarray, camera: Camera) -> PoseEstimate:
    """Refine a frame's pose on landmarks `x_w` (N, 3) [m, world] seen as its features `rows` (N,)."""
    xy, depth, sigma_px, sigma_z = (values.take(rows, axis=0) for values in (frame.xy, frame.depth, frame.sigma_px, frame.sigma_z))
    return camera_pose.refine_pose(T_cw, x_w, xy, depth, sigma_px, sigma_z, camera)
