"""track: features and matches -> a pose for every frame, and a map."""

from itertools import groupby
from pathlib import Path

import numpy as np

from slamcli import artifacts
from slamcli.config.options import Config
from slamcli.schema import (
    LOST,
    ON_DEPTH,
    RELOCALIZED,
    Features,
    FrameTimes,
    Matches,
    Moving,
    Rests,
    Words,
    check_matches,
)
from slamcli.slam import map_segments, moving_objects, rests
from slamcli.slam.background_motion import BackgroundMotion
from slamcli.slam.depth_tracking import FramePoints
from slamcli.slam.depth_views import Views
from slamcli.slam.moving_objects import UNDER_DRIFT
from slamcli.slam.recording import KnownMotion, TrackingInput
from slamcli.slam.tracker import Tracker
from slamcli.sparse_map.frame import FrameStore
from slamcli.stages import moving_parts
from slamcli.stages.contract import Inputs, Summary, Tools
from slamcli.stages.map_outputs import save_map
from slamcli.stages.moving_parts import NOTHING

BACKGROUND_ROUNDS = 2  # the second halves the error of the motion from frame to frame, a third does not help


def run(inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Track every frame and build the map of key frames and landmarks; where things move, once more without them."""
    features, moving = inputs.load(Features, "extract"), NOTHING
    tracker, stands_still = _track(inputs, moving, None, cfg, tools)
    if cfg.track.moving_objects and moving_parts.are_any(inputs, tracker.tracks(), tracker.map()):
        moving, background = _find_background(inputs, cfg, tools)
        tracker, stands_still = _track(inputs, moving, background, cfg, tools)
        moving = moving_parts.find(inputs, tracker.tracks(), tracker.map(), tools)
        shown, _ = moving_parts.still(inputs, moving)
        tracker.forget(np.flatnonzero(moving_objects.is_hidden(shown)))  # out of sight, they would draw the whole map there
    tracks = tracker.tracks()
    map_ = map_segments.from_first_frames(map_segments.ranked(tracker.map(), tracks), tracks)
    artifacts.save(moving, out)
    artifacts.save(stands_still, out)
    lost = lost_spans(tracks.state, tracker.lost_reason)
    for first, last, reason in lost:
        since = features.stamp[[first, last]] - features.stamp[0]
        spell = (
            f"frames {first} to {last} ({since[0]:.1f} to {since[1]:.1f} s) are" if last > first else f"frame {first} ({since[0]:.1f} s) is"
        )
        tools.warn(f"{spell} lost: {reason}")
    save_map(out, inputs.load(FrameTimes, "extract"), tracks, map_)
    return {
        "frames": len(features.stamp),
        "tracked": int((tracks.state != LOST).sum()),
        "lost": int((tracks.state == LOST).sum()),
        "relocalized": int((tracks.state == RELOCALIZED).sum()),
        "on_depth": int((tracks.state == ON_DEPTH).sum()),
        "at_rest": int(np.diff(stands_still.rest_span).sum()),
        "segments": map_segments.n_segments(map_),
        "key_frames": len(map_.kf_frame),
        "key_frame_reasons": dict(sorted(tracker.key_frame_reasons.items())),
        "landmarks": len(map_.lm_xyz),
        "edges": len(map_.edge_kf),
        "lost_spans": [list(span) for span in lost],
    } | moving_parts.figures(moving)


def _find_background(inputs: Inputs, cfg: Config, tools: Tools) -> tuple[Moving, np.ndarray]:
    """Find how the camera moved against what stands still, T_wc (F, 4, 4) that drift, and what moves under these poses.

    Once most of what moves is known, the motion is found again without it.
    """
    words, depth, camera = inputs.load(Words, "match"), moving_parts.coarse_images(inputs), inputs.camera()
    moving, T_wc = NOTHING, np.tile(np.eye(4), (len(depth), 1, 1))
    for number in range(BACKGROUND_ROUNDS):
        features, still = moving_parts.still(inputs, moving)
        motion = BackgroundMotion(features, words, still, camera, cfg.sensor, tools.rng())
        T_wc = motion.poses(lambda anchors: tools.progress(anchors, "background"), before=T_wc if number else None)
        views = Views(depth, np.asarray(features.stamp), T_wc, np.zeros(len(T_wc), dtype=np.int64), camera)
        moving = Moving(moving_objects.find(views, lambda frames: tools.progress(frames, "moving objects"), rule=UNDER_DRIFT))
    return moving, T_wc


def _track(inputs: Inputs, moving: Moving, background: np.ndarray | None, cfg: Config, tools: Tools) -> tuple[Tracker, Rests]:
    """Track every frame on what does not move; returns also when the camera stood still."""
    features, depth = moving_parts.still(inputs, moving)
    words, matches, camera = inputs.load(Words, "match"), inputs.load(Matches, "match"), inputs.camera()
    check_matches(matches, features)
    stands_still = rests.find(features, words, matches, camera) if cfg.track.rests else rests.NONE
    recording = TrackingInput(FrameStore(features, camera, cfg.sensor), words, matches, FramePoints(depth, camera, cfg.sensor))
    tracker = Tracker(recording, cfg.track, tools.rng(), motion=KnownMotion(background, stands_still))
    for i in tools.progress(range(len(features.stamp)), "track"):
        tracker.process(i)
    return tracker, stands_still


def lost_spans(state: np.ndarray, reason: dict[int, str]) -> list[tuple[int, int, str]]:
    """Join lost frames next to one another with their first reason."""
    spans = []
    for _, group in groupby(enumerate(np.flatnonzero(state == LOST)), key=lambda pair: pair[1] - pair[0]):
        frames = [int(frame) for _, frame in group]
        spans.append((frames[0], frames[-1], reason.get(frames[0], "no pose was found")))
    return spans
