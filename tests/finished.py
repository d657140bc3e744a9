"""A finished run without any SLAM: the truth with known noise, written as the stages would write it."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slamcli import artifacts
from slamcli.config.options import Config
from slamcli.files import digest
from slamcli.formats.cloud import write_ply
from slamcli.formats.trajectory import write_tum
from slamcli.geometry import se3
from slamcli.runs import pipeline, source_code, staleness
from slamcli.runs.damage import outputs
from slamcli.runs.run_directory import RunDir
from slamcli.schema import FORMAT, Closures, Doubt, Features, FrameTimes, Ground, Map, Moving, Timing, Tracks, Trajectory, trajectory
from slamcli.stages import STAGES

START = 1305031102.0  # [s]
RATE = 30.0  # frames per second
KEY_FRAMES_EVERY = 10
WIDTH, HEIGHT = 64, 48
NOISE = {"track": 0.02, "loop": 0.005}  # [m] along each axis


@dataclass(frozen=True)
class Finished:
    """A run and what is known about it."""

    run: Path
    recording: Path
    truth: Trajectory
    lost: np.ndarray  # (F,) bool


def wander(rng: np.random.Generator, stamp: np.ndarray) -> Trajectory:
    """A smooth hand-held motion through all six degrees of freedom."""
    t = stamp - stamp[0]
    phase, rate = rng.uniform(0, 6, 6), rng.uniform(0.3, 1.2, 6)
    return Trajectory(stamp=stamp, T_wc=se3.exp(np.stack([0.8 * np.sin(rate[k] * t + phase[k]) for k in range(6)], axis=1)))


def disturb(rng: np.random.Generator, truth: Trajectory, *, metres: float, radians: float = 0.0) -> Trajectory:
    """Add noise of known size to every pose."""
    noise = se3.exp(rng.normal(0, 1, (len(truth.stamp), 6)) * ([metres] * 3 + [radians] * 3))
    return Trajectory(stamp=truth.stamp, T_wc=truth.T_wc @ noise)


def write_recording(folder: Path, stamp: np.ndarray, truth: Trajectory | None) -> None:
    """Write a recording in the TUM layout whose images are small and hold nothing of interest."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    names = [f"{value:.6f}.png" for value in stamp]
    for name in names:
        cv2.imwrite(str(folder / "rgb" / name), picture)
        cv2.imwrite(str(folder / "depth" / name), np.full((HEIGHT, WIDTH), 7500, np.uint16))
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(f"{value:.6f} {kind}/{name}\n" for value, name in zip(stamp, names, strict=True)))
    camera = f'{{"width": {WIDTH}, "height": {HEIGHT}, "fx": 52.0, "fy": 52.0, "cx": 32.0, "cy": 24.0, "depth_scale": 5000.0}}'
    (folder / "camera.json").write_text(camera)
    if truth is not None:
        write_tum(folder / "groundtruth.txt", truth)


def make(
    folder: Path, *, seed: int = 0, frames: int = 90, n_lost: int = 6, with_truth: bool = True, until: str = "densify", n_doubtful: int = 0
) -> Finished:
    """Make recording and run below `folder`, with `n_lost` lost frames from the middle on, and as many doubtful ones more as said."""
    rng = np.random.default_rng(seed)
    stamp = np.round(START + np.arange(frames) / RATE, 6)
    truth = wander(rng, stamp)
    recording, path = folder / "recording", folder / "run"
    write_recording(recording, stamp, truth if with_truth else None)
    run = RunDir.create(path, dataset="recording", root=str(recording), digest="sha256:0")
    run.write_config(Config())
    lost = np.zeros(frames, dtype=bool)
    lost[frames // 2 : frames // 2 + n_lost] = True
    results = _results(rng, truth, lost, n_doubtful)
    for stage in STAGES:
        with run.writing(stage.name) as out:
            for value in results.get(stage.name, ()):
                artifacts.save(value, out)
            if stage.name in ("extract", "optimize", "loop"):
                (out / "camera.json").write_text((recording / "camera.json").read_text())
            if stage.name == "densify":
                write_ply(out / "cloud.ply", *_cloud(rng))
            if stage.name in ("track", "optimize", "loop"):
                tracks, map_ = (next(value for value in results[stage.name] if isinstance(value, kind)) for kind in (Tracks, Map))
                write_tum(out / "trajectory.txt", trajectory(stamp, tracks, map_))
            run.commit(stage.name, out, _record(run, stage, out, frames))
        if stage.name == until:
            break
    return Finished(run=path, recording=recording, truth=truth, lost=lost)


def _results(rng: np.random.Generator, truth: Trajectory, lost: np.ndarray, n_doubtful: int) -> dict[str, tuple]:
    frames = len(truth.stamp)
    no_rows = np.zeros(frames + 1, np.int64)
    features = Features(
        stamp=truth.stamp, depth_stamp=truth.stamp, offset=no_rows, xy=np.empty((0, 2), np.float32), depth=np.empty(0, np.float32), slope=np.empty((0, 2), np.float32),
        octave=np.empty(0, np.uint8), angle=np.empty(0, np.float32), desc=np.empty((0, 32), np.uint8), octave_scale=np.array(1.2),
    )  # fmt: skip
    kf_frame = np.flatnonzero(~lost)[::KEY_FRAMES_EVERY].astype(np.int32)
    found = {name: disturb(rng, truth, metres=metres) for name, metres in NOISE.items()}
    T_lw = se3.exp(np.array([0.1, 0.2, 1.2, 1.5, 0.1, 0.0]))
    ground = Ground(
        T_lw=T_lw, plane=np.append(T_lw[2, :3], T_lw[2, 3]), inlier_rms=np.array(0.01), inlier_share=np.array(0.5), is_found=np.array(True)
    )
    closures = Closures(
        closure_kf=np.array([[len(kf_frame) - 1, 0]], np.int32), closure_T_ij=np.eye(4)[None], closure_inliers=np.array([60], np.int32),
        closure_score=np.array([0.4], np.float32),
    )  # fmt: skip
    track, loop = (_tracks(found[name].T_wc, kf_frame, lost) for name in ("track", "loop"))
    maps = {name: _map(T_wc[kf_frame], kf_frame) for name, T_wc in (("track", found["track"].T_wc), ("loop", found["loop"].T_wc))}
    when = Timing(readout=np.array(0.0), depth_readout=np.array(0.0), depth_delay=np.array(0.0), twist=np.zeros((frames, 6)))
    unknown, sure = np.full(frames, np.nan, np.float32), np.where(lost, np.nan, 0.003).astype(np.float32)
    times = FrameTimes(stamp=truth.stamp, depth_stamp=truth.stamp)
    doubts = Doubt(
        contradicted=unknown,
        disagreement=unknown,
        sigma=sure,
        drift=np.zeros(frames, np.float32),
        is_doubtful=lost | (np.arange(frames) < n_doubtful),
    )
    return {
        "extract": (features,),
        "track": (track, times, Moving(), maps["track"]),
        "optimize": (track, times, when, maps["track"]),
        "loop": (loop, times, closures, when, Moving(), doubts, maps["loop"]),
        "densify": (ground,),
    }


def _cloud(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square of floor: points, colours, normals."""
    xyz = np.append(rng.uniform(-1, 1, (400, 2)), np.zeros((400, 1)), axis=1).astype(np.float32)
    return xyz, rng.integers(0, 255, (400, 3), dtype=np.uint8), np.tile(np.float32([0, 0, 1]), (400, 1))


def _tracks(T_wc: np.ndarray, kf_frame: np.ndarray, lost: np.ndarray) -> Tracks:
    ref = np.searchsorted(kf_frame, np.arange(len(T_wc)), side="right") - 1
    T_kc = se3.inverse(T_wc[kf_frame[ref]]) @ T_wc
    T_kc[lost] = np.nan
    state = np.where(lost, 0, 1).astype(np.uint8)
    state[kf_frame] = 2
    return Tracks(
        ref_kf=np.where(lost, -1, ref).astype(np.int32), T_kc=T_kc, state=state, n_inliers=np.where(lost, 0, 200).astype(np.int32)
    )


def _map(T_wk: np.ndarray, kf_frame: np.ndarray) -> Map:
    empty = np.empty(0, np.int32)
    return Map(
        kf_frame=kf_frame, kf_segment=np.zeros(len(kf_frame), np.int32), T_wk=T_wk, lm_xyz=np.empty((0, 3)), obs_lm=empty, obs_kf=empty, obs_row=np.empty(0, np.int64)
    )  # fmt: skip


def _record(run: RunDir, stage: pipeline.Stage, out: Path, frames: int) -> dict:
    declared = staleness.declared(stage, run.config())
    reader = "tum" if "dataset" in stage.needs else ""
    code = dict(source_code.of_stage(stage.name, reader))
    inputs = {need: "sha256:0" if need == "dataset" else run.record(need)["digest"] for need in stage.needs}
    files = outputs(out)
    return {
        "format": FORMAT, "stage": stage.name, "key": staleness.key(declared, inputs, code),
        "config": declared, "inputs": inputs, "code": code, "outputs": files,
        "digest": digest({name: entry["sha256"] for name, entry in files.items()}), "environment": pipeline.environment(),
        "seconds": 1.5, "cpu_seconds": 2.0, "compile_seconds": 0.0, "fps": frames / 1.5, "peak_rss_mb": 200.0,
        "summary": {"frames": frames}, "warnings": [], "n_warnings": 0, "reader": reader,
    }  # fmt: skip
