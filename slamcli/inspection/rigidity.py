"""Is the focal length right? Points that two pictures show, with their depth, must be a rigid body under it (calibration/plausibility.py)."""

from collections.abc import Iterator

import numpy as np

from slamcli.calibration import plausibility
from slamcli.calibration.plausibility import Rigidity, SeenTwice
from slamcli.config.options import SensorConfig
from slamcli.datasets import Dataset
from slamcli.datasets.recording import spread
from slamcli.depth import at_key_points
from slamcli.errors import BadFrame
from slamcli.vision import hamming, orb

PAIRS = 12  # of pictures, evenly spread
APART = 0.5  # [s] between the two of a pair: far enough to have turned, near enough to show the same
LEAST_PAIRS = 4  # that show enough points


def measure(dataset: Dataset) -> Rigidity | None:
    """Find the focal length under which points seen twice are most rigid; None where too few pictures show enough of them."""
    found = plausibility.most_rigid(_pairs(dataset), dataset.camera, SensorConfig())
    return found if found is not None and found.pairs >= LEAST_PAIRS else None


def _pairs(dataset: Dataset) -> Iterator[tuple[SeenTwice, SeenTwice]]:
    """Match the pictures of each pair."""
    later = np.searchsorted(dataset.stamp, dataset.stamp + APART)
    for i in spread(int((later < len(dataset)).sum()), PAIRS):
        try:
            first, second = (_look(dataset, frame) for frame in (i, int(later[i])))
        except BadFrame:
            continue
        if first is not None and second is not None:
            (a, of_a), (b, of_b) = first, second
            rows, _ = hamming.match_brute(hamming.Described(a.desc, a.angle), hamming.Described(b.desc, b.angle))
            yield SeenTwice(of_a.xy[rows[:, 0]], of_a.depth[rows[:, 0]]), SeenTwice(of_b.xy[rows[:, 1]], of_b.depth[rows[:, 1]])


def _look(dataset: Dataset, i: int) -> tuple[orb.KeyPoints, SeenTwice] | None:
    """Detect the features of a frame and read their depth; None where it has no depth or nothing to see."""
    depth = dataset.depth(i)
    points = orb.detect(dataset.grey(i))
    if depth is None or len(points) == 0:
        return None
    seen = SeenTwice(dataset.camera.undistort(points.xy.astype(np.float64)), at_key_points.depth_at(depth, points.xy).astype(np.float64))
    return points, seen
