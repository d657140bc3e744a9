"""What moves in the recording, as the stages share it: found under the poses of a stage, and left out of what others read."""

import numpy as np

from slamcli.depth.coarse_images import CoarseImages
from slamcli.geometry.camera import Camera
from slamcli.schema import CoarseDepth, Features, Map, Moving, Tracks, poses_in_segments
from slamcli.slam import gone_objects, moving_objects
from slamcli.slam.depth_views import Views
from slamcli.slam.moving_objects import FOR_POSES, Rule
from slamcli.stages.contract import Inputs, Stored, Summary, Tools

NOTHING = Moving()
MOVES = 0.01  # share of a view, from which on a frame counts as one with moving objects in the summary


def are_any(inputs: Inputs, tracks: Tracks, map_: Map) -> bool:
    """Say whether anything moves in the recording, seen from these poses; nothing does where depth is missing."""
    seen = views(inputs, tracks, map_)
    return seen.depth.size > 0 and moving_objects.is_any(seen)


def find(inputs: Inputs, tracks: Tracks, map_: Map, tools: Tools, *, rule: Rule = FOR_POSES) -> Moving:
    """Find what moves in every frame, seen from these poses."""
    found = moving_objects.find(views(inputs, tracks, map_), lambda frames: tools.progress(frames, "moving objects"), rule=rule)
    return Moving(found) if found.any() else Moving()


def coarse_images(inputs: Stored) -> CoarseImages:
    """Return the recording's coarse depth images."""
    return CoarseImages(inputs.load(CoarseDepth, "extract"))


def with_gone(inputs: Inputs, moving: Moving, recording: np.ndarray, tracks: Tracks, map_: Map, tools: Tools) -> Moving:
    """Add to what moves, for the maps, what stood in one recording and is gone in a later one; recording : (F,) number of each frame's."""
    seen = views(inputs, tracks, map_)
    gone = gone_objects.find(seen, recording, np.asarray(map_.kf_frame), lambda frames: tools.progress(frames, "gone objects", len(frames)))
    if not gone.any():
        return moving
    return Moving(gone | moving.moving if len(moving.moving) else gone)


def still(inputs: Stored, moving: Moving) -> tuple[Features, CoarseImages]:
    """Return the recording's features and coarse depth without what moves."""
    features, depth, camera = inputs.load(Features, "extract"), coarse_images(inputs), inputs.camera()
    return moving_objects.hide_features(features, moving.moving, camera), moving_objects.hide_coarse(depth, moving.moving, camera)


def still_depth(depth: np.ndarray, moving: Moving, frame: int, camera: Camera) -> np.ndarray:
    """Return a frame's depth image (H, W) [m] without what moves and a margin around it."""
    return moving_objects.hide_pixels(depth, moving.moving[frame], camera) if len(moving.moving) else depth


def figures(moving: Moving) -> Summary:
    """Tell how much moves: frames in which something does, and the mean share of their views."""
    share = moving.moving.mean(axis=(1, 2)) if len(moving.moving) else np.zeros(0)
    moves = share[share > MOVES]
    return {"frames_with_motion": len(moves), "share_that_moves": float(moves.mean())} if len(moves) else {}


def views(inputs: Inputs, tracks: Tracks, map_: Map) -> Views:
    """Gather the coarse depth images with these poses."""
    stamp, (segment, T_wc) = inputs.load(Features, "extract").stamp, poses_in_segments(tracks, map_)
    return Views(coarse_images(inputs), np.asarray(stamp), T_wc, segment, inputs.camera())
