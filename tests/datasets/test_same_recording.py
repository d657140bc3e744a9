"""One real recording, written into every layout that loses nothing, gives the same arrays as its own folder."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import layouts
import numpy as np
import pytest
from layouts import LAYOUTS, RAW_COLOUR, Content, Layout

from slamcli.datasets import Dataset, open_dataset
from slamcli.formats.trajectory import read_tum

RECORDING = Path(__file__).parents[3] / "shared/data/tum/rgbd_dataset_freiburg1_xyz"
FRAMES = (0, 300)


def content_of(dataset: Dataset, frames: tuple[int, ...], *, suffix: str) -> Content:
    """Take the stored bytes of some frames; as PNG, their pixels."""
    root, truth = dataset.root, read_tum(dataset.root / "groundtruth.txt")
    colour = [(root / dataset.colour_name[i]).read_bytes() for i in frames]
    if suffix == ".png":
        colour = [cv2.imencode(".png", cv2.cvtColor(dataset.rgb(i), cv2.COLOR_RGB2BGR))[1].tobytes() for i in frames]
    return Content(
        stamp=[round(float(dataset.stamp[i]) * 1e6) * 1000 for i in frames],
        depth_stamp=[round(float(dataset.depth_stamp[i]) * 1e6) * 1000 for i in frames],
        colour=colour,
        suffix=suffix,
        raw=[cv2.imread(str(root / dataset.depth_name[i]), cv2.IMREAD_UNCHANGED) for i in frames],
        camera={key: value for key, value in dataset.camera.to_dict().items() if key != "inverse_depth_offset"},
        T_wc=truth.T_wc[np.searchsorted(truth.stamp, dataset.stamp[list(frames)]).clip(0, len(truth.stamp) - 1)],
    )


@pytest.fixture(scope="module")
def recording() -> Dataset:
    if not RECORDING.is_dir():
        pytest.skip("freiburg1_xyz is not there")
    return open_dataset(str(RECORDING))


@pytest.fixture(scope="module")
def contents(recording: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, tuple[Content, Dataset]]]:
    """With colour as stored, and as PNG; each with the TUM folder it must agree with."""
    made = {}
    for suffix in (".jpg", ".png"):
        content = content_of(recording, FRAMES, suffix=suffix)
        made[suffix] = content, open_dataset(str(layouts.tum(content, tmp_path_factory.mktemp("tum") / "walk")))
    return made


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_every_layout_gives_the_same_arrays(layout: Layout, contents: dict[str, tuple[Content, Dataset]], tmp_path: Path) -> None:
    for module in layout.needs:
        pytest.importorskip(module)
    content, reference = contents[".png" if layout.name in RAW_COLOUR else ".jpg"]
    known = {key: value for key, value in content.camera.items() if key not in ("width", "height")}  # freiburg1's lens fits few layouts
    camera = known if layout.override else {key: value for key, value in known.items() if key != "depth_scale"}
    dataset = open_dataset(str(layout.write(content, tmp_path / "walk")), camera=camera)
    for i in range(len(FRAMES)):
        assert np.array_equal(dataset.grey(i), reference.grey(i)) and np.array_equal(dataset.rgb(i), reference.rgb(i))
        np.testing.assert_array_equal(dataset.depth(i), reference.depth(i))
    if layout.keeps_stamps:
        assert np.array_equal(dataset.stamp, reference.stamp)


def test_the_recording_itself_is_read_as_it_was_before(recording: Dataset) -> None:
    """Stamps and pairs as the data set's own script finds them."""
    assert (recording.reader, len(recording), recording.warnings) == ("tum", 798, [])
    assert np.isfinite(recording.depth_stamp).sum() >= 790
    assert np.nanmedian(np.abs(recording.depth_stamp - recording.stamp)) == pytest.approx(0.0073, abs=3e-4)
