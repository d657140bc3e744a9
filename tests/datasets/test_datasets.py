"""Finding a recording by name."""

from pathlib import Path

import pytest
from recordings import write_recording

from slamcli import datasets
from slamcli.datasets import open_dataset
from slamcli.errors import SlamError


@pytest.fixture(autouse=True)
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither data folder nor cache, and nothing is downloaded."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("SLAMCLI_DATA", raising=False)

    def refuse(sequence: str, *_: object, **__: object) -> Path:
        raise SlamError(f"would download {sequence}")

    monkeypatch.setattr("slamcli.datasets.download.download_tum", refuse)


@pytest.mark.parametrize(
    "target", ["tum/fr1_xyz", "tum/rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg1_xyz", "fr1_xyz", "tum/freiburg1_xyz"]
)
@pytest.mark.parametrize("stored", ["tum/rgbd_dataset_freiburg1_xyz", "tum/fr1_xyz", "rgbd_dataset_freiburg1_xyz"])
def test_both_ways_of_naming_find_both_ways_of_storing(tmp_path: Path, target: str, stored: str) -> None:
    folder = write_recording(tmp_path / "store" / stored)
    dataset = open_dataset(target, data=str(tmp_path / "store"))
    assert dataset.root == folder and dataset.name == "tum/fr1_xyz"


def test_order_of_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places = [tmp_path / name for name in ("given", "environment", "data", "cache/slamcli/datasets")]
    monkeypatch.setenv("SLAMCLI_DATA", str(places[1]))
    for place in reversed(places):
        write_recording(place / "tum" / "rgbd_dataset_freiburg3_x")
        found = open_dataset("tum/fr3_x", data=str(places[0]) if place == places[0] else None)
        assert found.root.resolve() == (place / "tum" / "rgbd_dataset_freiburg3_x").resolve()


def test_a_folder_counts_first_and_is_named_after_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_recording(tmp_path / "freiburg1_desk")
    assert open_dataset(str(folder)).name == "tum/fr1_desk"
    monkeypatch.chdir(folder)
    assert open_dataset(".").name == "tum/fr1_desk"


def test_aliases_of_the_literature() -> None:
    with pytest.raises(SlamError, match="would download rgbd_dataset_freiburg3_long_office_household"):
        open_dataset("tum/fr3_office")


def test_what_is_nowhere_is_downloaded_if_it_can_be() -> None:
    with pytest.raises(SlamError, match="would download rgbd_dataset_freiburg1_room"):
        open_dataset("tum/fr1_room")
    with pytest.raises(SlamError, match="no such recording; looked for this folder itself and under data, .*cache"):
        open_dataset("my/recording")


def test_user_mistakes_are_told(tmp_path: Path) -> None:
    (tmp_path / "archive.tgz").write_bytes(b"x")
    for target, data, said in [
        ("archive.tgz", None, "an archive; unpack it"),
        ("fr1_x", str(tmp_path / "none"), "data .* no such folder"),
        ("", None, "no recording named"),
        ("tum/fr9_x", None, "no such recording"),
    ]:
        with pytest.raises(SlamError, match=said):
            open_dataset(target, data=data)


def test_the_demo_is_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def render(out: Path, **settings: object) -> Path:
        calls.append(settings)
        return write_recording(out)

    monkeypatch.setattr("slamcli.datasets.demo.simulate", render)
    for _ in range(2):
        dataset = open_dataset("demo")
        assert dataset.name == "demo" and dataset.root.parent == tmp_path / "cache" / "slamcli"
    assert len(calls) == 1


def test_silent_passes_items_through() -> None:
    assert list(datasets.silent(range(3), "label", 3)) == [0, 1, 2]
