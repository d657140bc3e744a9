"""The TUM reader: association as the data set's own script does it, and every kind of broken recording."""

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import CAMERA, colour, depth, png, write_recording

from slamcli.datasets import open_dataset
from slamcli.datasets.association import associate
from slamcli.datasets.lists import read_list
from slamcli.errors import BadFrame, SlamError


def associate_naively(a: np.ndarray, b: np.ndarray, offset: float, most: float) -> list[tuple[int, int]]:
    """The loop of associate.py, on indices."""
    potential = [(abs(x - (y + offset)), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - (y + offset)) < most]
    free_a, free_b, pairs = set(range(len(a))), set(range(len(b))), []
    for _, i, j in sorted(potential):
        if i in free_a and j in free_b:
            free_a.remove(i)
            free_b.remove(j)
            pairs.append((i, j))
    return sorted(pairs)


stamps = st.lists(st.integers(0, 400), max_size=25, unique=True).map(lambda values: np.sort(np.array(values, dtype=float)) / 200)


@settings(deadline=None)
@given(a=stamps, b=stamps, offset=st.sampled_from([0.0, 0.01, -0.3]))
def test_association_equals_the_data_sets_script(a: np.ndarray, b: np.ndarray, offset: float) -> None:
    pairs = associate(a, b, offset=offset)
    assert pairs.shape[1] == 2
    assert [tuple(pair) for pair in pairs.tolist()] == associate_naively(a, b, offset, 0.02)


def test_the_bound_is_strict() -> None:
    assert len(associate(np.array([1.0]), np.array([1.5]), max_difference=0.5)) == 0  # halves are exact
    assert len(associate(np.array([1.0]), np.array([np.nextafter(1.5, 0.0)]), max_difference=0.5)) == 1


def test_dense_stamps_take_no_more_memory_than_there_are_lines() -> None:
    """All stamps of each list lie near all of the other: 25 million pairs are near enough, of which 5000 are taken."""
    dense = np.arange(5000) * 1e-7
    tracemalloc.start()
    pairs = associate(dense, dense + 3e-8)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_array_equal(pairs, np.stack([np.arange(5000)] * 2, axis=1))
    assert peak < 20_000_000


def test_values_of_a_sound_recording(tmp_path: Path) -> None:
    dataset = open_dataset(str(write_recording(tmp_path / "my room!")))
    assert (dataset.name, len(dataset), dataset.warnings) == ("my_room_", 4, [])
    np.testing.assert_allclose(dataset.depth_stamp - dataset.stamp, 0.004, atol=1e-6)
    metres = dataset.depth(2)
    raw = depth(2)
    assert metres.dtype == np.float32 and np.array_equal(np.isnan(metres), raw == 0)
    np.testing.assert_allclose(metres[raw > 0], raw[raw > 0] / 5000, rtol=1e-6)
    assert np.array_equal(dataset.rgb(1), colour(1)[..., ::-1])
    assert dataset.ground_truth() is None


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp"])
def test_any_image_suffix(tmp_path: Path, suffix: str) -> None:
    assert open_dataset(str(write_recording(tmp_path / "r", suffix=suffix))).grey(0).shape == (48, 64)


def test_ground_truth_is_read(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    (folder / "groundtruth.txt").write_text("# x\n0.0 1 2 3 0 0 0 1\n")
    assert open_dataset(str(folder)).ground_truth().T_wc[0, :3, 3].tolist() == [1, 2, 3]


def test_colour_without_depth_is_kept(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[:2] + lines[3:]))
    dataset = open_dataset(str(folder))
    assert len(dataset) == 4 and dataset.depth_name[1] == "" and np.isnan(dataset.depth_stamp[1])
    assert dataset.depth(1) is None and dataset.depth(2) is not None


def test_one_frame_is_enough(tmp_path: Path) -> None:
    assert len(open_dataset(str(write_recording(tmp_path / "r", frames=1)))) == 1


def test_unsorted_repeated_and_unusable_lines_are_put_right_with_warnings(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    lines = (folder / "rgb.txt").read_text().splitlines()
    lines = [lines[0], lines[3], lines[1], lines[2], lines[4], lines[4], "nan rgb/0.png", "garbage", "7.0", "inf rgb/1.png"]
    (folder / "rgb.txt").write_text("\n".join(lines))
    dataset = open_dataset(str(folder))
    assert dataset.colour_name == [f"rgb/{i}.png" for i in range(4)]
    assert (np.diff(dataset.stamp) > 0).all()
    text = "; ".join(dataset.warnings)
    assert "not sorted" in text and "repeated" in text and "4 unusable lines left out, the first is line 7" in text


def test_commas_tabs_and_windows_line_ends(tmp_path: Path) -> None:
    path = tmp_path / "rgb.txt"
    path.write_bytes(b"\xef\xbb\xbf# x\r\n1.0, rgb/a.png\r\n2.0\trgb/b.png\r\n")
    found = read_list(path)
    assert found.stamp.tolist() == [1.0, 2.0] and found.names == ["rgb/a.png", "rgb/b.png"] and found.warnings == []


@pytest.mark.parametrize("name", ["/etc/passwd", "../x.png", "rgb/../../x.png", "..\\x.png", "C:\\x.png", "\\\\host\\x.png"])
def test_paths_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    folder = write_recording(tmp_path / "r")
    (folder / "rgb.txt").write_text(f"0.0 {name}\n")
    with pytest.raises(SlamError, match=r"rgb\.txt:1: .* leads out"):
        open_dataset(str(folder))


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"rgb.txt": ""}, "lists no image"),
        ({"depth.txt": "# nothing\n"}, "lists no image"),
        ({"rgb.txt": "\x00\x01\x02\n"}, "lists no image"),
        ({"depth.txt": "50.0 depth/0.png\n"}, "no depth image lies within"),
        ({"rgb.txt": "1305031102175304000 rgb/0.png\n"}, "no depth image lies within"),
        ({"camera.json": CAMERA.replace("64", "65")}, "64 x 48 px but the calibration is for 65 x 48"),
        ({"depth/0.png": b"", "depth/1.png": b"", "depth/2.png": b"", "depth/3.png": b""}, "empty"),
        ({f"depth/{i}.png": png(depth(i).astype(np.uint8)) for i in range(4)}, "8 bits"),
        ({f"depth/{i}.png": png(depth(i)[:24, :64].copy()) for i in range(4)}, "not the shape"),
    ],
)
def test_recordings_that_make_no_sense_are_refused(tmp_path: Path, files: dict[str, str | bytes], said: str) -> None:
    folder = write_recording(tmp_path / "r")
    for name, content in files.items():
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(SlamError, match=said) as caught:
        open_dataset(str(folder))
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("more", "said"),
    [(" # blurred", "'# blurred' follows the file name rgb/0.png"), (" 0.004 depth/0.png", "associations.txt"), (",7", "'7' follows")],
)
def test_what_follows_a_file_name_is_told_with_its_line(tmp_path: Path, more: str, said: str) -> None:
    folder = write_recording(tmp_path / "r")
    path = folder / "rgb.txt"
    path.write_text(path.read_text().replace("rgb/0.png", f"rgb/0.png{more}"))
    with pytest.raises(SlamError, match=rf"rgb\.txt:2: .*{said}"):
        open_dataset(str(folder))


def test_a_name_with_a_blank_or_a_comma_is_a_name(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    (folder / "rgb" / "0.png").rename(folder / "rgb" / "a, b.png")
    path = folder / "rgb.txt"
    path.write_text(path.read_text().replace("rgb/0.png", "rgb/a, b.png"))
    assert open_dataset(str(folder)).colour_name[0] == "rgb/a, b.png"


@pytest.mark.parametrize("stamp", ["1e300", "-2e19"])
def test_a_stamp_beyond_all_clocks_costs_its_line(tmp_path: Path, stamp: str) -> None:
    folder = write_recording(tmp_path / "r")
    path = folder / "rgb.txt"
    path.write_text(path.read_text().replace("0.033333", stamp))
    dataset = open_dataset(str(folder))
    assert len(dataset) == 3 and dataset.warnings == [f"{path}: 1 unusable lines left out, the first is line 3"]


@pytest.mark.parametrize("odd", [0, 3])
def test_an_image_of_another_size_costs_its_frame_wherever_it_is(tmp_path: Path, odd: int) -> None:
    folder = write_recording(tmp_path / "r")
    (folder / "rgb" / f"{odd}.png").write_bytes(png(colour(odd)[:24, :32].copy()))
    dataset = open_dataset(str(folder))
    assert (dataset.camera.width, dataset.camera.height) == (64, 48)
    for i in range(4):
        if i == odd:
            with pytest.raises(BadFrame, match="is 32 x 24 px, the others are 64 x 48"):
                dataset.grey(i)
        else:
            assert dataset.grey(i).shape == (48, 64)


def test_camera_files_that_disagree_are_told_of(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    same = "width = 64\nheight = 48\nfx = 60.0\nfy = 60.0\ncx = 31.5\ncy = 23.5\ndepth_scale = 5000\n"
    (folder / "camera.toml").write_text(same)
    assert open_dataset(str(folder)).warnings == []
    (folder / "camera.toml").write_text(same.replace("fx = 60.0", "fx = 45.0"))
    dataset = open_dataset(str(folder))
    assert dataset.camera.fx == 45.0
    assert [text for text in dataset.warnings if "camera.json disagree (fx 45.0 and 60.0): camera.toml counts" in text]


@pytest.mark.parametrize("name", ["rgb.txt", "camera.json", "camera.toml"])
def test_a_dead_link_or_a_pipe_in_the_place_of_a_file_is_named(tmp_path: Path, name: str) -> None:
    folder = write_recording(tmp_path / "r")
    path = folder / name
    path.unlink(missing_ok=True)
    path.symlink_to("nowhere")
    with pytest.raises(SlamError, match=f"{name}: cannot be read"):
        open_dataset(str(folder))
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(SlamError, match=f"{name}: not a regular file"):
        open_dataset(str(folder))


def test_missing_lists(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    (folder / "depth.txt").unlink()
    with pytest.raises(SlamError, match=r"depth\.txt: cannot be read"):
        open_dataset(str(folder))
    (tmp_path / "empty").mkdir()
    with pytest.raises(SlamError, match="not a recording"):
        open_dataset(str(tmp_path / "empty"))
    with pytest.raises(SlamError, match="/dev/zero: a device or a pipe"):
        open_dataset("/dev/zero")


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", None])
def test_one_bad_frame_costs_one_frame(tmp_path: Path, content: bytes | None) -> None:
    folder = write_recording(tmp_path / "r")
    for path in (folder / "rgb" / "1.png", folder / "depth" / "2.png"):
        path.write_bytes(content) if content is not None else path.unlink()
    dataset = open_dataset(str(folder))
    for read in (lambda: dataset.grey(1), lambda: dataset.rgb(1), lambda: dataset.depth(2)):
        with pytest.raises(BadFrame):
            read()
    assert dataset.grey(2).shape == dataset.depth(1).shape == (48, 64)


def test_doubtful_depth_unit_is_warned_of(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    for i in range(4):
        (folder / "depth" / f"{i}.png").write_bytes(png((depth(i) / 5).astype(np.uint16)))  # millimetres
    assert "1000 (millimetres)" in open_dataset(str(folder)).warnings[0]
    assert open_dataset(str(folder), camera={"depth_scale": 1000}).warnings == []
    sound = write_recording(tmp_path / "sound")
    assert "camera.depth_scale = 5000" in open_dataset(str(sound), camera={"depth_scale": 250}).warnings[0]


def test_depth_images_without_any_reading_are_warned_of(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "r")
    for i in range(4):
        (folder / "depth" / f"{i}.png").write_bytes(png(np.zeros((48, 64), dtype=np.uint16)))
    assert "no reading" in open_dataset(str(folder)).warnings[0]


def test_digest_follows_what_a_result_depends_on(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "a")
    before = open_dataset(str(folder)).digest()
    folder.rename(tmp_path / "b")
    assert open_dataset(str(tmp_path / "b")).digest() == before  # a copy is the same recording
    assert open_dataset(str(tmp_path / "b"), camera={"fx": 61.0}).digest() != before
    (tmp_path / "b" / "rgb" / "1.png").write_bytes(b"other size")
    assert open_dataset(str(tmp_path / "b")).digest() != before
