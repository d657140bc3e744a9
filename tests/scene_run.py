"""The stages from track to loop on simulated landmarks, called as the pipeline calls them."""

from types import SimpleNamespace

import numpy as np
from scenes import CAMERA

from slamcli import artifacts
from slamcli.config.options import LoopConfig, OptimizeConfig, SensorConfig, TrackConfig
from slamcli.depth.coarse_images import encode
from slamcli.files import read_json
from slamcli.geometry.camera import Camera
from slamcli.schema import CoarseDepth, Features, FrameTimes, Map, Matches, Tracks, Words

SENSOR = SensorConfig(pixel_noise=0.5)


class Run:
    """The stages from track to loop on a scene, as the pipeline would call them."""

    def __init__(self, scene, folder, *, given=CAMERA, optimize=None, **loop_settings):
        self.scene, self.folder, self.given, self.warnings = scene, folder, given, []
        optimize = optimize or OptimizeConfig()
        self.workers = 2
        self.cfg = SimpleNamespace(track=TrackConfig(), sensor=SENSOR, optimize=optimize, loop=LoopConfig(**loop_settings))
        self.depth = encode(np.zeros((len(scene.features.stamp), 0, 0), np.uint16), (0, 0))
        self.warn, self.summary = self.warnings.append, {}

    def load(self, cls, stage):
        features = self.scene.features
        times = FrameTimes(features.stamp, features.depth_stamp)
        given = {Features: features, FrameTimes: times, Words: self.scene.words, Matches: self.scene.matches, CoarseDepth: self.depth}
        return given[cls] if cls in given else artifacts.load(cls, self.folder / stage)

    def camera(self, stage="extract"):
        if stage == "extract":
            return self.given
        path = self.folder / stage / "camera.json"
        return Camera.from_dict(read_json(path), source=str(path))

    def rng(self):
        return np.random.default_rng(0)

    def progress(self, items, label, total=None):
        return items

    def stage(self, module):
        name = module.__name__.split(".")[-1]
        (self.folder / name).mkdir()
        self.summary[name] = module.run(self, self.folder / name, self.cfg, self)

    def result(self, stage):
        return self.load(Tracks, stage), self.load(Map, stage)
