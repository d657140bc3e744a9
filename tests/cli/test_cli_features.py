"""slamcli vocab and slamcli inspect-features."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "pictures"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(4):
        picture = cv2.resize(rng.integers(0, 256, (12, 16)).astype(np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{k}.png"), picture)
    (folder / "broken.png").write_bytes(b"no picture")
    return folder


def train(slamcli, out: Path, *sources: object):
    return slamcli("vocab", "train", out, *sources, "--branching", 4, "--depth", 2, "--features", 100, "--min-size", 1)


def test_train_info_export_import(slamcli, tmp_path: Path, pictures: Path) -> None:
    made = train(slamcli, tmp_path / "a.npz", pictures)
    assert made.exit_code == 0 and "from 4 pictures" in made.stdout
    assert train(slamcli, tmp_path / "b.npz", pictures).exit_code == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    facts = json.loads(slamcli("vocab", "info", tmp_path / "a.npz", "--json").stdout)
    assert facts["words"] == 16 and facts["depth"] == 2 and facts["origin"] == "4 pictures of pictures"
    assert slamcli("vocab", "export", tmp_path / "a.txt", tmp_path / "a.npz").exit_code == 0
    back = slamcli("vocab", "import", tmp_path / "a.txt", tmp_path / "c.npz")
    assert back.exit_code == 0 and "16 words" in back.stdout
    again = json.loads(slamcli("vocab", "info", tmp_path / "c.npz", "--json").stdout)
    assert again["idf"] == facts["idf"] and "a.txt" in again["origin"]


def test_a_recording_can_be_trained_on(slamcli, tmp_path: Path, room: Path) -> None:
    made = slamcli("vocab", "train", tmp_path / "a.npz", room, "--depth", 1, "--features", 100, "--every", 20)
    assert made.exit_code == 0 and "from 2 pictures" in made.stdout


@pytest.mark.parametrize("content", [None, b"10 6 0 0\n0 1 2 3", b"\x00\x01"])
def test_what_cannot_be_imported_leaves_no_file(slamcli, tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "bad.txt").write_bytes(content)
    done = slamcli("vocab", "import", tmp_path / "bad.txt", tmp_path / "out.npz")
    assert done.exit_code == 1 and done.stderr.startswith("Error: ") and done.stderr.count("\n") == 1 and "bad.txt" in done.stderr
    assert not (tmp_path / "out.npz").exists()


def test_a_folder_without_pictures_is_a_clear_error(slamcli, tmp_path: Path) -> None:
    done = train(slamcli, tmp_path / "a.npz", tmp_path)
    assert done.exit_code == 1 and "neither pictures" in done.stderr


@pytest.mark.parametrize(
    "arguments, fault",
    [
        (("train", "no/such/a.npz", "."), "its folder is not there"),
        (("info", "broken.npz"), "not a vocabulary of slamcli"),
        (("info", "missing.npz"), "cannot be read"),
        (("export", "a.txt", "broken.npz"), "not a vocabulary of slamcli"),
        (("export", "no/such/a.txt"), "no/such/a.txt"),
    ],
)
def test_vocab_commands_refuse_in_one_line(
    slamcli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], fault: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("broken.npz").write_bytes(b"PK\x03\x04 no more")
    done = slamcli("vocab", *arguments)
    assert done.exit_code == 1 and fault in done.stderr and done.stderr.startswith("Error: ") and done.stderr.count("\n") == 1
    assert not Path("a.txt").exists()


def test_the_shipped_vocabulary_is_the_default(slamcli) -> None:
    facts = json.loads(slamcli("vocab", "info", "--json").stdout)
    assert facts["words"] >= 10_000 and facts["bytes"] <= 5_000_000
    assert "words" in slamcli("vocab", "info").stdout


def test_inspect_features_draws_both_and_tells_how_even_they_are(slamcli, tmp_path: Path, room: Path) -> None:
    done = slamcli("inspect-features", room, 3, tmp_path / "out.png", "--features", 200, "--json")
    assert done.exit_code == 0
    figures = json.loads(done.stdout)
    assert set(figures) == {"OpenCV ORB", "slamcli"} and figures["slamcli"]["points"] <= 200
    assert cv2.imread(str(tmp_path / "out.png")).shape == (148, 328, 3)


@pytest.mark.parametrize(
    "frame, out, fault",
    [(99, "out.png", "has no frame 99"), (0, "out.xyz", "not a kind of picture"), (0, "no/out.png", "its folder is not there")],
)
def test_inspect_features_refuses_in_one_line(slamcli, tmp_path: Path, room: Path, frame: int, out: str, fault: str) -> None:
    done = slamcli("inspect-features", room, frame, tmp_path / out)
    assert done.exit_code == 1 and fault in done.stderr and done.stderr.count("\n") == 1
