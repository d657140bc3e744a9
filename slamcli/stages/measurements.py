"""What features and depth images measured, as all after `optimize` reads it: under what is known of one camera, or of several."""

from dataclasses import replace

import numpy as np

from slamcli.calibration import self_calibration
from slamcli.calibration.self_calibration import Sensing
from slamcli.geometry.camera import Camera
from slamcli.schema import DepthTimes, Features, FrameTimes, Measured, Timing
from slamcli.slam import moving_objects
from slamcli.slam.moving_objects import OUT_OF_SIGHT
from slamcli.stages.contract import Stored


def corrected(stored: Stored, features: Features, given: Camera, sensing: Sensing) -> Features:
    """Return features of extract, measured under the calibration `given`, as `sensing` says they are; what was hidden stays so."""
    if not sensing.timing.is_of_several:
        return self_calibration.correct(features, given, sensing)
    measured, is_hidden = stored.load(Measured, "optimize"), moving_objects.is_hidden(features)
    return replace(
        features,
        depth_stamp=np.array(stored.load(DepthTimes, "optimize").depth_time),
        xy=np.where(is_hidden[:, None], np.float32(OUT_OF_SIGHT), measured.measured_xy),
        depth=np.where(is_hidden, np.float32(np.nan), measured.measured_depth),
    )


def depth_times(stored: Stored, times: FrameTimes) -> np.ndarray:
    """Return when each frame's depth was measured, (F,) [s], NaN where there is none or it is not moved; known once loop has been run."""
    when = stored.load(Timing, "loop")
    return stored.load(DepthTimes, "loop").depth_time if when.is_of_several else times.depth_stamp + float(when.depth_delay)
