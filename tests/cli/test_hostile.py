"""What a user can type or put in a file ends in one line, in bounded time."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from slamcli import files
from slamcli.errors import SlamError

Slamcli = Callable[..., Result]


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "room", "--room", "nan", "nan"),
        ("simulate", "room", "--speed", "inf"),
        ("render", "cloud.png", "--azimuth", "nan"),
        ("export-mesh", "mesh.ply", "--voxel", "nan"),
        ("plan", "--start", "nan,0", "--goal", "1,1"),
        ("plan", "--start", "0,0", "--goal", "1,1", "--radius", "nan"),
        ("inspect", "room", "--depth-scale", "nan"),
        ("eval", "rpe", "--seconds", "inf"),
    ],
)
def test_a_number_that_is_none_is_refused_before_anything_is_done(slamcli: Slamcli, here: Path, arguments: tuple[str, ...]) -> None:
    result = slamcli(*arguments)
    assert result.exit_code == 2
    assert "is not a finite number" in result.stderr
    assert not os.listdir(here)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"a" + b".a" * 20_000 + b" = 1", "a key of"),
        (b"[a" + b".a" * 100_000 + b"]", "a key of"),
        (b"seed = {a" + b" . a" * 20_000 + b" = 1}", "a key of"),
        (b"seed = " + b"9" * 5000, "not valid TOML"),
        (b"seed = 0x" + b"f" * 400, "too large a number"),
        (b"camera.fx = 0x" + b"f" * 5000, "too large a number"),
        (b"seed = " + b"[" * 100_000, "not valid TOML"),
        (b"seed = " + b"[" * 300 + b"]" * 300, "must be a whole number"),
        (b"\xff\xfe", "not valid TOML"),
        (b'match.vocabulary = "~nouser/x.npz"', "not the name of a file"),
        (b'match.vocabulary = "a\\u0000b"', "not the name of a file"),
        (b"x" * 900_000, "not valid TOML"),
    ],
)
def test_a_hostile_configuration_is_refused_at_once(slamcli: Slamcli, here: Path, text: bytes, said: str) -> None:
    (here / "mine.toml").write_bytes(text)
    started = time.process_time()
    result = slamcli("config", "--defaults", "--config", "mine.toml")
    assert time.process_time() - started < 2.0
    assert result.exit_code == 1
    assert said in result.stderr
    assert len(result.stderr) < 1000


def test_a_configuration_or_a_map_in_a_pipe_is_not_waited_for(slamcli: Slamcli, here: Path) -> None:
    for name in ("pipe.toml", "pipe.yaml", "pipe.npz", "pipe.txt"):
        os.mkfifo(name)
    (here / "zero.toml").symlink_to("/dev/zero")
    for arguments in (
        ("config", "--defaults", "--config", "zero.toml"),
        ("plan", "--start", "0,0", "--goal", "1,1", "--map", "pipe.yaml"),
        ("vocab", "info", "pipe.npz"),
        ("vocab", "import", "pipe.txt"),
    ):
        result = slamcli(*arguments)
        assert result.exit_code == 1
        assert result.stderr.startswith("Error: ")


def test_assignments_follow_the_same_bounds(slamcli: Slamcli) -> None:
    for assignment in ("seed=" + "9" * 5000, "seed=0x" + "f" * 400, "match.vocabulary=~nouser/x", "track.min_inliers=1\na.a=2"):
        result = slamcli("config", "--defaults", "-s", assignment)
        assert result.exit_code == 1
        assert len(result.stderr.strip().splitlines()) <= 2


def test_a_configuration_may_hold_what_ours_hold(here: Path) -> None:
    found = files.parse_toml(b'\xef\xbb\xbfa.b.c = 1\nname = "x.y.z.tar.gz"\nlist = [0.1, 0.2, 0.3]\n', source="x")
    assert found == {"a": {"b": {"c": 1}}, "name": "x.y.z.tar.gz", "list": [0.1, 0.2, 0.3]}
    with pytest.raises(SlamError, match="x: not valid TOML"):
        files.parse_toml(b"a = ", source="x")
