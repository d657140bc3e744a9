"""Replace the key-frame rule of the tracker by one of your own, and compare the two maps.

    python examples/own_key_frame_rule.py [RECORDING]

RECORDING is anything that `slamcli run` takes; without it the demo is used, a simulated room.
"""

import sys

import numpy as np

import slamcli
from slamcli.config.options import TrackConfig
from slamcli.schema import LOST, Features, Matches, Words, frame_poses
from slamcli.slam.key_frames import DEFAULT_RULE, KeyFrameRule, Sighting
from slamcli.slam.recording import TrackingInput
from slamcli.slam.tracker import Tracker
from slamcli.sparse_map.frame import FrameStore

LEFT = 0.5  # share of the reference key frame's landmarks


def thrifty(seen: Sighting, settings: TrackConfig) -> str:
    """Ask for a key frame only where half of the reference is out of view, however much is new; the text is the reason, "" asks for none."""
    return "half is left" if seen.n_landmarks < LEFT * seen.n_reference else ""


def main(recording: str = "demo") -> None:
    """Track a recording under either rule, and print what became of it."""
    run = slamcli.run(recording, until="match")
    T_wc = {}
    for name, rule in (("default", DEFAULT_RULE), ("thrifty", KeyFrameRule(by_landmarks=thrifty))):
        tracker = track(run, rule)
        tracks, map_ = tracker.tracks(), tracker.map()
        T_wc[name] = frame_poses(tracks, map_)
        counts = ", ".join(f"{reason}: {n}" for reason, n in sorted(tracker.key_frame_reasons.items()))
        print(
            f"{name:8s} {len(map_.kf_frame)} key frames ({counts}), {len(map_.lm_xyz)} landmarks, {np.count_nonzero(tracks.state == LOST)} lost"
        )
    apart = np.linalg.norm(T_wc["thrifty"][:, :3, 3] - T_wc["default"][:, :3, 3], axis=1)
    print(f"the two trajectories lie {1000 * np.nanmedian(apart):.1f} mm apart, median")


def track(run: slamcli.Run, rule: KeyFrameRule) -> Tracker:
    """Track all frames of a run that has features, words and matches."""
    load, config = run.directory.load, run.config()
    frames = FrameStore(load(Features, "extract"), run.camera("extract"), config.sensor)
    recording = TrackingInput(frames, load(Words, "match"), load(Matches, "match"))
    tracker = Tracker(recording, config.track, np.random.default_rng(config.seed), rule=rule)
    for i in range(len(frames)):
        tracker.process(i)
    return tracker


if __name__ == "__main__":
    main(*sys.argv[1:])
