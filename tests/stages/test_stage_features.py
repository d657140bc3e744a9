"""The stages extract and match on a small simulated room and on damaged recordings."""

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from recordings import write_recording

from slamcli import artifacts
from slamcli.config.options import Config, ExtractConfig, MatchConfig
from slamcli.datasets import open_dataset
from slamcli.depth import at_key_points
from slamcli.errors import SlamError
from slamcli.formats import vocabulary_file
from slamcli.geometry.camera import Camera
from slamcli.schema import Features, Flow, Matches, Words
from slamcli.slam.place_recognition import bow_vector
from slamcli.stages import extract, match
from slamcli.vision import hamming, orb, vocabulary


class Tools:
    """What a stage is given; warnings are kept."""

    def __init__(self, workers: int = 2) -> None:
        self.workers, self.warnings = workers, []

    def progress(self, iterable, label: str, total: int | None = None):
        return iterable

    def warn(self, message: str) -> None:
        self.warnings.append(message)


def run_extract(recording: Path, out: Path, workers: int = 2, **options) -> tuple[Features, dict, list[str]]:
    out.mkdir()
    tools = Tools(workers)
    inputs = SimpleNamespace(dataset=open_dataset(str(recording)))
    summary = extract.run(inputs, out, SimpleNamespace(extract=ExtractConfig(**options), seed=0), tools)
    return artifacts.load(Features, out), summary, tools.warnings


def run_match(features: Features, out: Path, *, flow: Flow = Flow(), **options) -> tuple[Words, Matches, dict]:  # noqa: B008
    out.mkdir()
    inputs = SimpleNamespace(load=lambda cls, stage: {Features: features, Flow: flow}[cls])
    summary = match.run(inputs, out, SimpleNamespace(match=MatchConfig(**options), seed=0), Tools())
    return artifacts.load(Words, out), artifacts.load(Matches, out), summary


@pytest.fixture(scope="module")
def features(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Features:
    return run_extract(room, tmp_path_factory.mktemp("stage") / "extract", features=200)[0]


def test_features_are_those_of_each_frame(room: Path, features: Features) -> None:
    dataset = open_dataset(str(room))
    assert len(features.stamp) == len(dataset) and features.octave_scale == Config().extract.scale
    for i in (0, 17, len(dataset) - 1):
        points = orb.detect(dataset.grey(i), ExtractConfig(features=200))
        span = slice(features.offset[i], features.offset[i + 1])
        np.testing.assert_array_equal(features.desc[span], points.desc)
        np.testing.assert_allclose(features.xy[span], dataset.camera.undistort(points.xy), atol=1e-4)
        column, row = np.rint(points.xy).astype(int).T
        depth, found = dataset.depth(i), np.isfinite(features.depth[span])
        np.testing.assert_array_equal(features.depth[span][found], depth[row, column][found])
        settings = Config().extract
        is_behind = at_key_points.is_behind_outline(
            depth, points.xy, settings.scale ** points.octave.astype(float), jump=settings.depth_jump
        )
        is_without = np.isnan(depth[row, column]) | is_behind
        np.testing.assert_array_equal(~found, is_without)
    assert 0.3 < np.isfinite(features.depth).mean() <= 1.0


def test_one_worker_or_three_give_the_same_files(room: Path, tmp_path: Path) -> None:
    for workers in (1, 3):
        run_extract(room, tmp_path / str(workers), workers, features=100)
    for path in sorted((tmp_path / "1").iterdir()):
        assert path.read_bytes() == (tmp_path / "3" / path.name).read_bytes(), path.name


def test_camera_and_association_are_written_for_other_programs(room: Path, tmp_path: Path) -> None:
    features, _, _ = run_extract(room, tmp_path / "extract", features=100)
    dataset = open_dataset(str(room))
    written = Camera.from_dict(json.loads((tmp_path / "extract" / "camera.json").read_text()), source="camera.json")
    assert written == dataset.camera
    lines = [line.split() for line in (tmp_path / "extract" / "frames.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(lines) == np.isfinite(features.depth_stamp).sum()
    for stamp, colour, depth_stamp, depth in lines:
        i = dataset.colour_name.index(colour)
        assert depth == dataset.depth_name[i]
        assert [float(stamp), float(depth_stamp)] == pytest.approx([dataset.stamp[i], dataset.depth_stamp[i]], abs=1e-6)


@pytest.mark.shows("extract.depth_jump")
def test_key_points_behind_an_outline_have_no_depth(tmp_path: Path) -> None:
    recording = texture_recording(tmp_path / "recording", frames=1)
    (path,) = (recording / "depth").iterdir()
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[:], image[:, : image.shape[1] // 2] = 10000, 5000
    cv2.imwrite(str(path), image)
    all_have, _, _ = run_extract(recording, tmp_path / "all", depth_jump=0.0)
    some, _, _ = run_extract(recording, tmp_path / "some")
    beside = all_have.xy[:, 0] - image.shape[1] // 2  # the nearer half is on the left
    behind, others = (beside >= 0) & (beside < 2), (beside < -1) | (beside > 5)
    assert behind.any() and (others & (beside < 0) & (beside > -4)).any() and np.isfinite(all_have.depth).all()
    assert np.isnan(some.depth[behind]).all() and np.isfinite(some.depth[others]).all()


def texture_recording(folder: Path, frames: int = 6) -> Path:
    """A recording whose pictures have corners at all, which those of `write_recording` may lack."""
    recording = write_recording(folder, frames=frames)
    tiles = np.random.default_rng(0).integers(0, 256, (12, 16, 3)).astype(np.uint8)
    for path in sorted((recording / "rgb").iterdir()):
        shape = cv2.imread(str(path)).shape
        cv2.imwrite(str(path), cv2.resize(tiles, shape[1::-1], interpolation=cv2.INTER_NEAREST))
    return recording


def test_frames_that_cannot_be_used_are_skipped_and_counted(tmp_path: Path) -> None:
    recording = texture_recording(tmp_path / "recording")
    colour, depth = (sorted((recording / kind).iterdir()) for kind in ("rgb", "depth"))
    colour[1].write_bytes(b"")
    depth[2].write_bytes(depth[2].read_bytes()[:40])
    cv2.imwrite(str(colour[3]), np.full_like(cv2.imread(str(colour[3])), 255))
    depth[4].unlink()
    features, summary, warnings = run_extract(recording, tmp_path / "extract")
    n = np.diff(features.offset)
    assert n[0] > 0 and n[1] == 0 and n[2] > 0 and n[3] == 0 and n[5] > 0
    assert np.isnan(features.depth_stamp[[1, 2, 4]]).all() and np.isfinite(features.depth_stamp[[0, 3, 5]]).all()
    for frame in (2, 4):
        assert np.isnan(features.depth[features.offset[frame] : features.offset[frame + 1]]).all()
    of_frames = [warning for warning in warnings if warning.startswith("frame ")]
    assert summary["bad_images"] == len(of_frames) == 3
    assert colour[1].name in of_frames[0] and "frame 1" in of_frames[0]
    words, matches, _ = run_match(features, tmp_path / "match")
    assert np.diff(words.word_offset)[1] == 0
    assert len(matches.pair) == 5 and np.diff(matches.offset)[[0, 1]].tolist() == [0, 0]


def test_a_recording_without_any_feature_is_a_clear_error(tmp_path: Path) -> None:
    recording = write_recording(tmp_path / "recording")
    for path in (recording / "rgb").iterdir():
        cv2.imwrite(str(path), np.full_like(cv2.imread(str(path)), 128))
    features, summary, warnings = run_extract(recording, tmp_path / "extract")
    assert len(features.xy) == summary["features"] == summary["with_depth"] == 0
    assert any("no feature in any" in text and "by the shape alone" in text for text in warnings)
    for path in (recording / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
    with pytest.raises(SlamError, match="no feature in any"):
        run_extract(recording, tmp_path / "again")


def test_one_frame_is_enough(tmp_path: Path) -> None:
    recording = texture_recording(tmp_path / "recording", frames=1)
    features, summary, _ = run_extract(recording, tmp_path / "extract")
    words, matches, _ = run_match(features, tmp_path / "match")
    assert summary["frames"] == 1 and len(matches.pair) == 0 and matches.offset.tolist() == [0]
    assert len(words.word) == features.offset[-1]


@pytest.mark.shows("match.window")
def test_words_and_matches_keep_their_promises(features: Features, tmp_path: Path) -> None:
    words, matches, summary = run_match(features, tmp_path / "match", window=3)
    n_frames = len(features.stamp)
    assert summary["pairs"] == len(matches.pair) == 3 * n_frames - 6
    assert (matches.pair[:, 1] < matches.pair[:, 0]).all() and (matches.pair[:, 0] - matches.pair[:, 1] <= 3).all()
    assert [tuple(p) for p in matches.pair] == sorted(tuple(p) for p in matches.pair)
    assert words.word.dtype == matches.row.dtype == np.uint16 and words.second_node.dtype == np.int8  # as narrow as the values allow
    _, node = vocabulary.quantize(
        vocabulary_file.read(""), features.desc, node_level=MatchConfig().node_level, margin=MatchConfig().node_margin
    )
    np.testing.assert_array_equal(words.node(slice(0, None)), node)
    some = np.array([5, 1, 5])
    np.testing.assert_array_equal(words.node(some), node[some])
    for p, (i, j) in enumerate(matches.pair[:9]):
        rows = matches.row[matches.offset[p] : matches.offset[p + 1]]
        assert len(np.unique(rows[:, 0])) == len(np.unique(rows[:, 1])) == len(rows)
        bits = np.bitwise_count(features.desc[features.offset[i] + rows[:, 0]] ^ features.desc[features.offset[j] + rows[:, 1]]).sum(axis=1)
        assert bits.max() <= 64
        assert (rows < [features.offset[i + 1] - features.offset[i], features.offset[j + 1] - features.offset[j]]).all()
    for f in range(n_frames):
        word, weight = bow_vector(words, f)
        assert len(word) and (np.diff(word) > 0).all()
        assert weight.sum() == pytest.approx(1.0, abs=1e-4)


@pytest.mark.shows("match.method")
def test_words_find_nearly_what_brute_force_finds(features: Features, tmp_path: Path) -> None:
    by_word, brute = (run_match(features, tmp_path / method, method=method)[1] for method in ("words", "brute"))
    found = {(p, *row) for p in range(len(brute.pair)) for row in by_word.row[by_word.offset[p] : by_word.offset[p + 1]].tolist()}
    expected = {(p, *row) for p in range(len(brute.pair)) for row in brute.row[brute.offset[p] : brute.offset[p + 1]].tolist()}
    assert 0.85 < len(found & expected) / len(expected) < 1.0
    i, j = (slice(features.offset[f], features.offset[f + 1]) for f in brute.pair[4])
    rows, _ = hamming.match_brute(*(hamming.Described(features.desc[rows], features.angle[rows]) for rows in (i, j)))
    np.testing.assert_array_equal(rows, brute.row[brute.offset[4] : brute.offset[5]])


@pytest.mark.shows("extract.flow", "match.flow_below")
def test_flow_adds_matches_only_where_descriptors_give_few(room: Path, tmp_path: Path) -> None:
    features, _, _ = run_extract(room, tmp_path / "extract", features=200, flow=True)
    flow = artifacts.load(Flow, tmp_path / "extract")
    assert flow.flow_xy.shape == features.xy.shape and 0.5 < np.isfinite(flow.flow_xy[: features.offset[-2], 0]).mean() < 1.0
    assert np.isnan(flow.flow_xy[features.offset[-2] :]).all()  # no frame follows the last
    plain, never, always = (
        run_match(features, tmp_path / name, flow=given, flow_below=below)[1]
        for name, given, below in (("plain", Flow(), 1000), ("never", flow, 0), ("always", flow, 1000))
    )
    assert plain.row.tobytes() == never.row.tobytes() and len(always.row) > 1.1 * len(plain.row)
    for p, (i, j) in enumerate(always.pair):
        rows = always.row[always.offset[p] : always.offset[p + 1]]
        before = plain.row[plain.offset[p] : plain.offset[p + 1]]
        np.testing.assert_array_equal(rows[: len(before)], before)
        assert len(np.unique(rows[:, 0])) == len(rows) == len(np.unique(rows[:, 1]))
        more = rows[len(before) :]
        ends = flow.flow_xy[features.offset[j] + more[:, 1]] - features.xy[features.offset[i] + more[:, 0]]
        assert (np.linalg.norm(ends, axis=1) <= 2.0).all()
