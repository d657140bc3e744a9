"""Signs that the calibration is not that of the recording, as text: focal length, principal point, lens, depth that lies off colour."""

from slamcli.calibration import plausibility
from slamcli.calibration.plausibility import Deviation, Rigidity
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import SensorConfig
from slamcli.geometry.camera import Camera
from slamcli.slam.doubt import Finding
from slamcli.sparse_map.sparse_map import SparseMap

# Sound recordings have deviations too, as they stand for other errors: real ones 0.058 of the focal length, 0.019 of the width for the principal
# point, 0.033 of k1, 0.0034 of the width between depth and colour. A fault goes beyond what is tolerated by so many standard deviations: sound
# recordings reach 4.4 (few textures, 160 px wide), a principal point 20 px off begins at 7.9 (320 px wide) and 16 (640).
TOLERATED = {"focal": 0.06, "cx": 0.015, "cy": 0.015, "k1": 0.05, "shift_x": 0.005, "shift_y": 0.005}
CERTAIN = 5.0
RIGID_GAIN, RIGID_FACTOR = 1.25, 1.05  # sound recordings reach 1.05, 1.17 with people in view, and without any gain 1.3
RIGID_PAIRS = 4


def judge(sparse_map: SparseMap, now: Sensing, sensor: SensorConfig) -> list[Finding]:
    """Test whether an adjusted map bears out the camera that it was made with; returns the likeliest fault alone."""
    rigid = plausibility.rigidity(sparse_map, now.camera, sensor)
    return about(plausibility.deviations(sparse_map, now, sensor), rigid, now.camera)


def about(found: dict[str, Deviation], rigid: Rigidity | None, camera: Camera) -> list[Finding]:
    """Name the likeliest fault: faults look a little like one another, and the greatest is the one that is there."""
    if rigid is not None and rigid.pairs >= RIGID_PAIRS and rigid.gain >= RIGID_GAIN and not 1 / RIGID_FACTOR < rigid.factor < RIGID_FACTOR:
        return [_focal_length(rigid.factor, camera)]
    excess = {name: one.beyond(TOLERATED[name]) for name, one in found.items()}
    worst = max(excess, key=excess.__getitem__, default="")
    if not worst or excess[worst] < CERTAIN:
        return []
    if worst == "focal":
        return [_focal_length(1.0 + found["focal"].value, camera)]
    if worst == "k1":
        return [_lens(found["k1"].value, camera)]
    return [_depth_shift(found, camera) if worst.startswith("shift") else _principal_point(found, camera)]


def _focal_length(factor: float, camera: Camera) -> Finding:
    text = (
        f"the focal length does not fit what the recording shows: about fx = {camera.fx * factor:.0f} px would, not {camera.fx:.0f}; "
        "the calibration is of another camera or picture size, or pictures were scaled or cut: give the right fx and fy"
    )
    return Finding("focal_length", text, is_grave=True)


def _principal_point(found: dict[str, Deviation], camera: Camera) -> Finding:
    x, y = (camera.width * found[name].value for name in ("cx", "cy"))
    text = (
        f"the principal point does not fit what the recording shows: about ({camera.cx + x:.0f}, {camera.cy + y:.0f}) px would, not "
        f"({camera.cx:.0f}, {camera.cy:.0f}); pictures were cut, cx and cy are of other pictures, or depth lies off colour: give the right cx and cy"
    )
    return Finding("principal_point", text, is_grave=True)


def _lens(change: float, camera: Camera) -> Finding:
    text = (
        f"the lens distortion does not fit what the recording shows: about k1 = {camera.k1 + change:.2f} would, not {camera.k1:.2f}; "
        "the coefficients are of another camera, or the pictures have been undistorted already (then all are 0)"
    )
    return Finding("lens", text, is_grave=True)


def _depth_shift(found: dict[str, Deviation], camera: Camera) -> Finding:
    x, y = (camera.width * found[name].value for name in ("shift_x", "shift_y"))
    text = (
        f"depth does not lie on colour: it seems to be off by ({x:+.0f}, {y:+.0f}) px or more; "
        "it was not registered to colour, or with another calibration, or taken at another time, and the map's scale is in doubt"
    )
    return Finding("depth_shift", text, is_grave=True)
