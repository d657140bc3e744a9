"""The first four stages of a run of several recordings: each joins what the same stage made of every recording alone.

Frames are numbered through, recording after recording, and every number that counts frames, features, key frames or map segments moves
along; pixels are told in those of one camera. So no recording's result depends on another's, and a recording that is added later leaves
them as they are. What ties them together is left to `loop`.
"""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import artifacts, files, mapped_memory
from slamcli.calibration import self_calibration
from slamcli.calibration.self_calibration import Sensing
from slamcli.config.options import Config
from slamcli.datasets.joined import JoinedDataset
from slamcli.depth import icp
from slamcli.depth.coarse_images import encode
from slamcli.errors import SlamError
from slamcli.geometry import elementary
from slamcli.geometry.camera import Camera
from slamcli.geometry.common_camera import Retelling
from slamcli.hints import hint
from slamcli.schema import (
    CoarseDepth,
    DepthTimes,
    Features,
    Flow,
    FrameTimes,
    Map,
    Matches,
    Measured,
    Moving,
    Recordings,
    Rests,
    Timing,
    Tracks,
    Words,
)
from slamcli.slam import depth_views, doubt, map_segments, moving_objects
from slamcli.slam.doubt import Finding
from slamcli.stages import match
from slamcli.stages.association_file import write_association
from slamcli.stages.camera_file import write_camera
from slamcli.stages.contract import Inputs, Record, Stored, Summary, Tools
from slamcli.stages.map_outputs import save_map
from slamcli.stages.moving_parts import coarse_images
from slamcli.stages.of_several import NAMES_FILE

LARGEST_OCTAVE = 255
ADDED = ("features", "pairs", "frames_without_depth", "bad_images", "tracked", "lost", "relocalized", "on_depth", "at_rest", "key_frames", "landmarks",
         "edges", "frames", "frames_with_motion")  # counts of stages that add up  # fmt: skip


@dataclass(frozen=True)
class RecordingPart:
    """What a stage made of one recording."""

    name: str
    made: Stored
    summary: Summary

    @property
    def camera(self) -> Camera:
        """Read the recording's own camera."""
        return self.made.camera("extract")

    def load(self, cls: type[Record], stage: str) -> Record:
        """Read a record of arrays that `stage` wrote, to be read alone."""
        return artifacts.adopted(self.made.load(cls, stage))


def join_extract(parts: Sequence[RecordingPart], inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Join the features of recordings, and their coarse depth."""
    dataset = inputs.dataset
    assert isinstance(dataset, JoinedDataset)
    found = [part.load(Features, "extract") for part in parts]
    how = [dataset.retelling(k) for k in range(len(parts))]
    has_depth = np.concatenate([np.isfinite(one.depth_stamp) for one in found])
    n_with_depth = 0
    with artifacts.Writer(Features, out, "xy", "depth", "slope", "octave", "angle", "desc") as writer:
        for one, h in zip(found, how, strict=True):
            for rows in mapped_memory.blocks(one.desc):
                writer.append(
                    xy=h.pixels(one.xy[rows]),
                    depth=one.depth[rows],
                    slope=one.slope[rows] * np.float32(1.0 / h.magnification),
                    octave=_octaves(one.octave[rows], float(one.octave_scale), h),
                    angle=one.angle[rows],
                    desc=one.desc[rows],
                )
                n_with_depth += int(np.isfinite(one.depth[rows]).sum())
        joined = writer.finish(
            stamp=dataset.stamp,
            depth_stamp=np.where(has_depth, dataset.depth_stamp, np.nan),
            offset=_offsets([one.offset for one in found]),
            octave_scale=np.array(found[0].octave_scale),
        )
    _save_coarse(parts, how, dataset.camera, out)
    artifacts.save(Flow(), out)
    artifacts.save(dataset.recordings(), out)
    files.write_text(out / NAMES_FILE, json.dumps(dataset.names) + "\n")
    write_association(out / "frames.txt", dataset, joined.depth_stamp)
    write_camera(out, dataset.camera)
    n = np.diff(joined.offset)
    return _added(parts) | {
        "features_per_frame": [int(n.min()), float(np.median(n)), int(n.max())],
        "with_depth": n_with_depth / max(1, int(n.sum())),
        "recordings": len(parts),
    }


def join_match(parts: Sequence[RecordingPart], inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Join the words of recordings and the matches within them; none are sought between them."""
    first = inputs.load(Recordings, "extract").recording_offset
    words = [part.load(Words, "match") for part in parts]
    matches = [part.load(Matches, "match") for part in parts]
    with artifacts.Writer(Words, out, "word", "second_node") as word_writer:
        for word, second in ((one.word[rows], one.second_node[rows]) for one in words for rows in mapped_memory.blocks(one.word)):
            word_writer.append(word=word.astype(np.int32), second_node=second.astype(np.int32))
        joined = word_writer.finish(
            idf=np.array(words[0].idf),
            word_node=words[0].word_node.astype(np.int32),
            word_offset=_offsets([one.word_offset for one in words]),
        )
    with artifacts.Writer(Matches, out, "row") as match_writer:
        for row in (one.row[rows] for one in matches for rows in mapped_memory.blocks(one.row)):
            match_writer.append(row=row.astype(np.int32))
        pairs = match_writer.finish(
            pair=np.concatenate([one.pair + np.int32(at) for one, at in zip(matches, first, strict=False)]),
            offset=_offsets([one.offset for one in matches]),
        )
    return _added(parts) | {
        "matches_per_pair": float(np.median(np.diff(pairs.offset))) if len(pairs.pair) else 0.0,
        "words": len(joined.idf),
        "words_seen": int((joined.idf[match.seen(joined)] > 0).sum()),
    }


def join_track(parts: Sequence[RecordingPart], inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Put the maps of recordings side by side, each in a world of its own, and with them what moves."""
    features, offset = inputs.load(Features, "extract"), inputs.load(Recordings, "extract").recording_offset
    tracks, map_ = _joined_map(parts, "track", features, offset)
    artifacts.save(_moving(parts, inputs.camera()), out)
    rests = [part.made.load(Rests, "track").rest_span + np.int32(at) for part, at in zip(parts, offset, strict=False)]
    artifacts.save(Rests(rest_span=np.concatenate(rests)), out)
    save_map(out, inputs.load(FrameTimes, "extract"), tracks, map_)
    spans = [
        [first + int(at), last + int(at), reason]
        for part, at in zip(parts, offset, strict=False)
        for first, last, reason in part.summary["lost_spans"]
    ]
    reasons = sum((Counter(part.summary["key_frame_reasons"]) for part in parts), Counter[str]())
    shares = [part.summary["share_that_moves"] for part in parts if "share_that_moves" in part.summary]
    return (
        _added(parts)
        | {"segments": map_segments.n_segments(map_), "key_frame_reasons": dict(sorted(reasons.items())), "lost_spans": spans}
        | ({"share_that_moves": float(np.mean(shares))} if shares else {})
    )


def join_optimize(parts: Sequence[RecordingPart], inputs: Inputs, out: Path, cfg: Config, tools: Tools) -> Summary:
    """Put the adjusted maps of recordings side by side, with what their features measured once each one's own timing is taken out.

    Raises SlamError where calibrations were to be found: those of several recordings cannot be told in one camera's pixels beforehand.
    """
    for name in ("intrinsics", "depth_scale"):
        if getattr(cfg.optimize, name):
            raise SlamError(
                f"optimize.{name}: not with several recordings; find it in a run of one, then give what camera.json says there "
                f"with {hint().setting('camera.fx')}"
            )
    features, offset, camera = inputs.load(Features, "extract"), inputs.load(Recordings, "extract").recording_offset, inputs.camera()
    tracks, map_ = _joined_map(parts, "optimize", features, offset)
    save_map(out, inputs.load(FrameTimes, "extract"), tracks, map_)
    timings = [part.made.load(Timing, "optimize") for part in parts]
    twist = np.concatenate([timing.twist for timing in timings])
    artifacts.save(Timing(np.array(0.0), np.array(np.nan), np.array(0.0), twist=twist), out)
    _save_measured(parts, timings, camera, out)
    delay = np.repeat([float(timing.depth_delay) for timing in timings], np.diff(offset))
    artifacts.save(DepthTimes(depth_time=features.depth_stamp + delay), out)
    write_camera(out, camera)
    return _added(parts)


Join = Callable[[Sequence[RecordingPart], Inputs, Path, Config, Tools], Summary]
JOINS: dict[str, Join] = {"extract": join_extract, "match": join_match, "track": join_track, "optimize": join_optimize}


def _added(parts: Sequence[RecordingPart]) -> dict[str, Any]:
    """Add up the counts of recordings, and collect the doubts about each."""
    names = [name for name in ADDED if any(name in part.summary for part in parts)]
    doubts = [
        Finding(row["name"], f"{part.name}: {row['text']}", row["is_grave"]) for part in parts for row in part.summary.get(doubt.DOUBTS, [])
    ]
    return {name: sum(part.summary.get(name, 0) for part in parts) for name in names} | doubt.to_summary(doubts)


def _offsets(offsets: Sequence[np.ndarray]) -> np.ndarray:
    """Join columns that delimit ragged rows."""
    lengths = np.concatenate([np.diff(offset) for offset in offsets])
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


def _starts(lengths: Sequence[int]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


def _octaves(octave: np.ndarray, scale: float, how: Retelling) -> np.ndarray:
    """Tell octaves (N,) as the common camera would have seen the points: as finely as it resolves, so much blurred are they there."""
    if how.is_identity:
        return octave
    levels = np.round(elementary.log(how.magnification) / elementary.log(scale))
    return np.clip(octave + levels, 0, LARGEST_OCTAVE).astype(np.uint8)


def _save_coarse(parts: Sequence[RecordingPart], how: Sequence[Retelling], common: Camera, out: Path) -> None:
    """Join the coarse depth images of recordings; code is taken as it is where the camera is the common one."""
    offsets = []
    with artifacts.Writer(CoarseDepth, out, "coarse_code") as writer:
        for part, h in zip(parts, how, strict=True):
            told = part.load(CoarseDepth, "extract") if h.is_identity else _retold(part, h)
            offsets.append(told.coarse_offset)
            for rows in mapped_memory.blocks(told.coarse_code):
                writer.append(coarse_code=told.coarse_code[rows])
        writer.finish(coarse_shape=np.array(icp.coarse_shape(common), dtype=np.int32), coarse_offset=_offsets(offsets))


def _retold(part: RecordingPart, how: Retelling) -> CoarseDepth:
    """Return a recording's coarse depth images as the common camera's."""
    small = Retelling(icp.coarse_camera(how.own)[0], icp.coarse_camera(how.common)[0])

    def tell(image: np.ndarray) -> np.ndarray:
        metres = np.where(image > 0, image * np.float32(icp.UNIT), np.float32(np.nan)).astype(np.float32)
        units = np.rint(np.nan_to_num(small.depth(metres)) / np.float32(icp.UNIT))
        return np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)

    images = coarse_images(part.made)
    return encode((tell(images[frame]) for frame in range(len(images))), icp.coarse_shape(how.common))


def _joined_map(parts: Sequence[RecordingPart], stage: str, features: Features, offset: np.ndarray) -> tuple[Tracks, Map]:
    """Join poses and maps; segments are numbered by the frames that belong to them."""
    maps = [part.made.load(Map, stage) for part in parts]
    tracks = [part.made.load(Tracks, stage) for part in parts]
    kf, lm = (_starts([len(column) for column in columns]) for columns in ([m.kf_frame for m in maps], [m.lm_xyz for m in maps]))
    segment = _starts([map_segments.n_segments(m) for m in maps])
    row = features.offset[offset]

    def moved(name: str, by: np.ndarray) -> np.ndarray:
        columns = (getattr(m, name) for m in maps)
        return np.concatenate([column + np.array(at, column.dtype) for column, at in zip(columns, by, strict=False)])

    joined = Map(
        kf_frame=moved("kf_frame", offset),
        kf_segment=moved("kf_segment", segment),
        T_wk=np.concatenate([m.T_wk for m in maps]),
        lm_xyz=np.concatenate([m.lm_xyz for m in maps]),
        obs_lm=moved("obs_lm", lm),
        obs_kf=moved("obs_kf", kf),
        obs_row=moved("obs_row", row),
        edge_kf=moved("edge_kf", kf),
        edge_T_ij=np.concatenate([m.edge_T_ij for m in maps]),
        edge_information=np.concatenate([m.edge_information for m in maps]),
    )
    found = Tracks(
        ref_kf=np.concatenate([np.where(t.ref_kf >= 0, t.ref_kf + at, -1) for t, at in zip(tracks, kf, strict=False)]).astype(np.int32),
        T_kc=np.concatenate([t.T_kc for t in tracks]),
        state=np.concatenate([t.state for t in tracks]),
        n_inliers=np.concatenate([t.n_inliers for t in tracks]),
    )
    return found, map_segments.ranked(joined, found)


def _save_measured(parts: Sequence[RecordingPart], timings: Sequence[Timing], camera: Camera, out: Path) -> None:
    with artifacts.Writer(Measured, out, "measured_xy", "measured_depth") as writer:
        for part, timing in zip(parts, timings, strict=True):
            corrected = self_calibration.correct(part.load(Features, "extract"), part.camera, Sensing(part.camera, timing, {}))
            how = Retelling(part.camera, camera)
            for rows in mapped_memory.blocks(corrected.xy):
                writer.append(measured_xy=how.pixels(corrected.xy[rows]), measured_depth=corrected.depth[rows])
        writer.finish()


def _moving(parts: Sequence[RecordingPart], camera: Camera) -> Moving:
    """Join what moves, told in blocks of the common camera's picture; nothing where nothing moves in any recording."""
    found = [part.made.load(Moving, "track").moving for part in parts]
    if not any(len(one) for one in found):
        return Moving()
    told = [
        moving_objects.retold(one, part.camera, camera)
        if len(one)
        else np.zeros((part.summary["frames"], *depth_views.shape(camera)), dtype=bool)
        for part, one in zip(parts, found, strict=True)
    ]
    return Moving(np.concatenate(told))
