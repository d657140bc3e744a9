"""Find the camera of a new recording in the map of an old run."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slamcli.calibration import rolling_shutter, self_calibration
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import Config
from slamcli.datasets import Dataset
from slamcli.errors import SlamError
from slamcli.files import scratch
from slamcli.runs.pipeline import Pipeline
from slamcli.runs.run_directory import RunDir
from slamcli.schema import LOST, Features, Map, Matches, Timing, Tracks, Trajectory, Words, trajectory
from slamcli.slam import frame_refinement
from slamcli.slam.depth_tracking import FramePoints
from slamcli.slam.localizer import KnownMap, Localizer
from slamcli.slam.place_recognition import PlaceIndex
from slamcli.slam.recording import TrackedRecording, TrackingInput
from slamcli.sparse_map.frame import FrameStore
from slamcli.sparse_map.sparse_map import SparseMap
from slamcli.stages import measurements
from slamcli.stages.moving_parts import coarse_images

LOOKS = 2  # at all frames with hindsight: the motion that rectifies them comes from the look before

Progress = Callable[..., Iterable]


@dataclass(frozen=True)
class Localized:
    """Where the camera of a recording was in the world of a run."""

    trajectory: Trajectory  # of the frames that were found
    n_frames: int

    @property
    def coverage(self) -> float:
        """Return the share of the frames that were found."""
        return len(self.trajectory.stamp) / self.n_frames

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {"n_frames": self.n_frames, "n_poses": len(self.trajectory.stamp), "coverage": self.coverage}


def localize(run: RunDir, recording: Dataset, *, progress: Progress) -> Localized:
    """Find every frame of `recording` in the map that loop left in `run`; the map stays as it is.

    The recording goes through extract and match under the run's own configuration, in a folder that is removed again.
    Raises SlamError where the run has no map or where no frame was recognized.
    """
    config = run.config()
    for stage in ("loop", "match"):
        run.stage_path(stage)
    with scratch("slamcli-localize-") as folder:
        new = RunDir.create(folder / "run", dataset=recording.name, root=str(recording.root.resolve()), digest=recording.digest())
        new.write_config(config)
        Pipeline(new, config, dataset=recording).bring_up_to_date(until="match")
        return _find(run, new, config, progress)


def _find(run: RunDir, new: RunDir, config: Config, progress: Progress) -> Localized:
    map_, when = run.load(Map, "loop"), run.load(Timing, "loop")
    given, camera = run.camera(), run.camera("loop")
    sparse_map = SparseMap.from_map(measurements.corrected(run, run.load(Features, "extract"), given, Sensing(camera, when, {})), map_)
    if when.is_of_several:  # which of their cameras it is is not known
        when = replace(when, depth_readout=np.array(0.0))
    features = new.load(Features, "extract")
    if new.camera() == given:  # the same camera: what the run found of it holds here too
        features = self_calibration.recalibrate(features, given, camera)
    else:
        camera = new.camera()
    known = KnownMap(
        sparse_map,
        PlaceIndex(run.load(Words, "match"), sparse_map.kf.frame),
        FramePoints(coarse_images(run), given, config.sensor).under(run.camera("loop")),
    )
    recording = TrackingInput(
        FrameStore(features, camera, config.sensor),
        new.load(Words, "match"),
        new.load(Matches, "match"),
        FramePoints(coarse_images(new), new.camera(), config.sensor).under(camera),
    )
    localizer = Localizer(known, recording, config.track, np.random.default_rng(config.seed))
    for i in progress(range(len(features.stamp)), "localize"):
        localizer.process(i)
    tracks = localizer.tracks()
    if (tracks.state == LOST).all():
        raise SlamError(f"{new.info()['root']}: no frame was recognized in the map of {run.path}; do both show the same place?")
    tracks = _refine(sparse_map, recording.frames, tracks, when, map_, config, progress)
    return Localized(trajectory(np.array(features.stamp), tracks, map_), len(features.stamp))


def _refine(
    sparse_map: SparseMap, frames: FrameStore, tracks: Tracks, when: Timing, map_: Map, config: Config, progress: Progress
) -> Tracks:
    """Look at all frames again, their features rectified by the timing that the run found for its camera."""
    for _ in range(LOOKS):
        moving = replace(when, twist=rolling_shutter.frame_twists(frames.features.stamp, tracks, map_))
        rectified = replace(frames, features=rolling_shutter.rectify(frames.features, moving, frames.camera))
        tracked = TrackedRecording(rectified, tracks)
        tracks = frame_refinement.refine_frames(sparse_map, tracked, config.track, progress, workers=config.run.workers)
    return tracks
