"""The frames of a recording, each as its features with their noise: the form that matching against the map takes."""

from dataclasses import dataclass

import numpy as np

from slamcli.config.options import SensorConfig
from slamcli.geometry.camera import Camera
from slamcli.schema import Features
from slamcli.sparse_map import guided_matching, map_adjustment
from slamcli.sparse_map.guided_matching import FrameFeatures


@dataclass(frozen=True)
class FrameStore:
    """The features of all frames of a recording, the camera that saw them, and how well it measures."""

    features: Features
    camera: Camera
    sensor: SensorConfig

    def __len__(self) -> int:
        return len(self.features.stamp)

    def __getitem__(self, i: int) -> FrameFeatures:
        """Gather the features of frame `i` with their noise, sorted into buckets of the image."""
        features = self.features
        rows = slice(int(features.offset[i]), int(features.offset[i + 1]))
        measured = map_adjustment.measure(features, rows, self.sensor)
        xy = np.array(features.xy[rows])
        bucket_start, bucket_rows = guided_matching.sort_into_buckets(xy, self.camera)
        return FrameFeatures(
            camera=self.camera,
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
