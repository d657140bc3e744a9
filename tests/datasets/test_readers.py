"""The contract that every reader meets, over one recording written into every layout by code of its own."""

import importlib.util
from pathlib import Path

import cv2
import layouts
import numpy as np
import pytest
from layouts import LAYOUTS, Content, Layout
from recordings import png

from slamcli.datasets import READERS, open_dataset
from slamcli.errors import BadFrame, SlamError
from slamcli.geometry.camera import Camera

SIZE = (64, 48)
FRAMES = 12
CAMERA = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 24.0, "depth_scale": 5000.0}


@pytest.fixture(scope="module")
def content() -> Content:
    """A picture that moves, and depth that no rule doubts."""
    rng = np.random.default_rng(3)
    wall = cv2.GaussianBlur(rng.integers(0, 256, (SIZE[1], SIZE[0] + 3 * FRAMES, 3)).astype(np.float32), (0, 0), 2.0)
    pictures = [png(np.clip(3 * wall[:, 3 * i : 3 * i + SIZE[0]] - 256, 0, 255).astype(np.uint8), ".jpg") for i in range(FRAMES)]
    raw = [
        np.round(5000 * (1.5 + 0.02 * i + 0.005 * np.arange(SIZE[0])[None] + np.zeros((SIZE[1], 1)))).astype(np.uint16)
        for i in range(FRAMES)
    ]
    for image in raw:
        image[:3, :7] = 0
    T_wc = np.tile(np.eye(4), (FRAMES, 1, 1))
    T_wc[:, 0, 3] = 0.01 * np.arange(FRAMES)
    stamp = [1305031102_175304000 + 33_333_000 * i for i in range(FRAMES)]
    return Content(stamp, [s + 4_000_000 for s in stamp], pictures, ".jpg", raw, dict(CAMERA), T_wc)


@pytest.fixture(scope="module", params=LAYOUTS, ids=lambda layout: layout.name)
def written(request: pytest.FixtureRequest, content: Content, tmp_path_factory: pytest.TempPathFactory) -> tuple[Layout, Path]:
    layout: Layout = request.param
    if any(importlib.util.find_spec(module) is None for module in layout.needs):
        pytest.skip(f"{layout.needs} not installed")
    return layout, layout.write(content, tmp_path_factory.mktemp("layouts") / layout.name)


def opened(layout: Layout, path: Path):
    return open_dataset(str(path), camera={key: CAMERA[key] for key in layout.override} or None)


def test_every_reader_is_written_by_a_layout_or_has_tests_of_its_own() -> None:
    assert {reader.name for reader in READERS} - {layout.reader for layout in LAYOUTS} <= {"strayscanner", "azure_mkv", "realsense"}


def test_exactly_one_reader_claims_it_first(written: tuple[Layout, Path]) -> None:
    layout, path = written
    assert next(reader.name for reader in READERS if reader.layout.recognises(path)) == layout.reader


def test_content_comes_back_as_it_was_written(written: tuple[Layout, Path], content: Content) -> None:
    layout, path = written
    dataset = opened(layout, path)
    assert (dataset.reader, len(dataset), dataset.root) == (layout.reader, FRAMES, path)
    expected = Camera(**CAMERA)
    given = {key: value for key, value in dataset.camera.to_dict().items() if key != "depth_scale"}
    assert given == pytest.approx({key: value for key, value in expected.to_dict().items() if key != "depth_scale"}, rel=1e-6)
    for i in range(FRAMES):
        assert np.array_equal(dataset.rgb(i), content.bgr(i)[..., ::-1])
        np.testing.assert_array_equal(dataset.depth(i), expected.metres[content.raw[i]])
        assert dataset.depth(i).dtype == np.float32
    stored = cv2.imdecode(np.frombuffer(content.colour[0], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(dataset.grey(0).astype(int) - stored).max() <= 2  # pixels without a file have another luma than their JPEG


def test_stamps_are_kept_bit_for_bit_where_the_layout_has_them(written: tuple[Layout, Path], content: Content) -> None:
    layout, path = written
    dataset = opened(layout, path)
    if layout.keeps_stamps:
        true = np.array([float(layouts.seconds(stamp)) for stamp in content.stamp])
        assert np.array_equal(dataset.stamp, true)
        offset = 0.004 if layout.keeps_depth_stamps else 0.0
        np.testing.assert_allclose(dataset.depth_stamp - dataset.stamp, offset, atol=1e-6)
    else:
        np.testing.assert_allclose(np.diff(dataset.stamp), 1 / 30, rtol=1e-9)
        (told,) = (warning for warning in dataset.warnings if "30 Hz assumed" in warning)
        assert "stamps are frame numbers" in told if layout.reader == "icl_nuim" else told.endswith(", in the order of their numbers")


def test_contract(written: tuple[Layout, Path]) -> None:
    layout, path = written
    dataset = opened(layout, path)
    n = len(dataset)
    assert dataset.stamp.shape == dataset.depth_stamp.shape == (n,) and (np.diff(dataset.stamp) > 0).all()
    assert len(dataset.colour_name) == len(dataset.depth_name) == n and len(set(dataset.colour_name)) == n
    assert [bool(name) for name in dataset.depth_name] == np.isfinite(dataset.depth_stamp).tolist()
    assert dataset.grey(0).shape == dataset.depth(0).shape == (dataset.camera.height, dataset.camera.width)
    assert dataset.rgb(0).shape == (dataset.camera.height, dataset.camera.width, 3)
    assert dataset.mask(0) is None and dataset.depth_camera is None
    assert all(isinstance(warning, str) and "\n" not in warning for warning in dataset.warnings)
    again = opened(layout, path)
    assert again.digest() == dataset.digest()
    assert open_dataset(str(path), camera={**dict.fromkeys(layout.override, 5000.0), "fx": 66.0}).digest() != dataset.digest()


def test_random_access_gives_what_reading_in_order_gives(written: tuple[Layout, Path]) -> None:
    layout, path = written
    dataset = opened(layout, path)
    in_order = [dataset.rgb(i) for i in range(len(dataset))]
    for i in np.random.default_rng(0).permutation(len(dataset)):
        assert np.array_equal(opened(layout, path).rgb(i) if i % 5 == 0 else dataset.rgb(i), in_order[i])


def test_threads_read_what_one_reads(written: tuple[Layout, Path]) -> None:
    from slamcli.parallel import ordered_map

    layout, path = written
    dataset = opened(layout, path)
    alone = [dataset.depth(i) for i in range(len(dataset))]
    for one, many in zip(alone, ordered_map(dataset.depth, range(len(dataset)), workers=4), strict=True):
        np.testing.assert_array_equal(one, many)


@pytest.mark.parametrize("kept", [0.0, 0.02, 0.3, 0.6, 0.97])
def test_files_that_are_cut_off_are_told(written: tuple[Layout, Path], tmp_path: Path, kept: float) -> None:
    """Single files: opened with what is whole, or refused in one line that names them; never a traceback."""
    layout, path = written
    if path.is_dir() and not any(path.glob("*.db3")) and not any(path.glob("*.mcap")):
        pytest.skip("a folder of images")
    copied = _cut_copy(path, tmp_path, lambda data: data[: int(kept * len(data))])
    _opens_or_is_told(layout, copied)


def test_a_second_camera_without_all_its_intrinsics_is_told(content: Content, tmp_path: Path) -> None:
    root = layouts.scannet(content, tmp_path / "scan")
    open_dataset(str(root))
    for name in ("depth", "color"):
        path = root / "intrinsic" / f"intrinsic_{name}.txt"
        good = path.read_text()
        path.write_text("fx: 500.0\ncx: 4.0\n")
        with pytest.raises(SlamError, match="camera lacks fy, cy"):
            open_dataset(str(root))
        path.write_text(good)


def test_files_with_damaged_bytes_are_told(written: tuple[Layout, Path], tmp_path: Path) -> None:
    layout, path = written
    if path.is_dir() and not any(path.glob("*.db3")) and not any(path.glob("*.mcap")):
        pytest.skip("a folder of images")
    for seed in range(8):
        rng = np.random.default_rng(seed)

        def spoil(data: bytes, rng: np.random.Generator = rng) -> bytes:
            values = np.frombuffer(data, np.uint8).copy()
            near = rng.integers(0, min(len(values), 2000), 10)
            values[near] = rng.integers(0, 256, len(near))
            anywhere = rng.integers(0, len(values), 40)
            values[anywhere] = rng.integers(0, 256, len(anywhere))
            return values.tobytes()

        _opens_or_is_told(layout, _cut_copy(path, tmp_path / str(seed), spoil))


def _cut_copy(path: Path, out: Path, change) -> Path:
    out.mkdir(exist_ok=True)
    if path.is_file():
        (out / path.name).write_bytes(change(path.read_bytes()))
        return out / path.name
    (out / path.name).mkdir()
    for file in path.iterdir():
        data = file.read_bytes()
        (out / path.name / file.name).write_bytes(change(data) if file.suffix in (".db3", ".mcap") else data)
    return out / path.name


def _opens_or_is_told(layout: Layout, path: Path) -> None:
    said = []
    try:
        dataset = opened(layout, path)
    except SlamError as error:
        said.append(str(error))
        assert path.name in said[0]
    else:
        for read, i in ((read, i) for read in (dataset.grey, dataset.depth) for i in range(len(dataset))):
            try:
                read(i)
            except BadFrame as error:
                said.append(str(error))
    assert all("\n" not in text for text in said)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_nothing_else_is_claimed(reader, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("rgb")
    for path in (tmp_path / "empty", tmp_path / "notes.txt", tmp_path):
        assert not reader.layout.recognises(path)
