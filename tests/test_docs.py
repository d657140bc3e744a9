"""What the documents tell a user to type and to write is what the program takes."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from slamcli.cli.main import cli
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.geometry.camera import Camera

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK, COMMAND = re.compile(r"^ *```\w*\n(.*?)^ *```", re.M | re.S), re.compile(r"^\s*(?:\$ )?(slamcli [^\n]*)$", re.M)
INLINE = re.compile(r"`(slamcli [^`]*)`")


def commands(page: Path) -> list[str]:
    text = page.read_text(encoding="utf-8")
    found = [line for block in BLOCK.findall(text) for line in COMMAND.findall(block)] + INLINE.findall(BLOCK.sub("", text))
    assert found or page.name not in ("README.md", "frames.md", "robot.md")
    return [" ".join(line.split("#")[0].split()) for line in found]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_and_option_in_the_documents_is_known(page: Path) -> None:
    for line in commands(page):
        words = shlex.split(line)[1:]
        command, path = cli, []
        while words and hasattr(command, "commands") and words[0] in command.commands:
            path.append(words.pop(0))
            command = command.commands[path[-1]]
        if not path:
            assert not words or words[0].startswith("-"), f"{page.name}: {line}"
            continue
        known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)} | {"-h", "--help"}
        for word in words:
            assert not re.match(r"--?[a-z]", word) or word.partition("=")[0] in known, f"{page.name}: {line}: {word}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_setting_in_the_documents_is_known(page: Path) -> None:
    for assignment in re.findall(r"-s ((?!section\.)[a-z0-9_]+\.[a-z0-9_]+=[^\s`]+)", page.read_text(encoding="utf-8")):
        toml.apply(Config(), [assignment])


def test_the_camera_file_in_the_documents_is_whole_and_right() -> None:
    text = re.search(r"```toml\n(.*?)```", (ROOT / "docs" / "robot.md").read_text(encoding="utf-8"), re.S).group(1)
    camera = Camera.from_dict(tomllib.loads("\n".join(line.strip() for line in text.splitlines())), source="docs/robot.md")
    assert (camera.width, camera.height, camera.depth_scale) == (640, 480, 1000.0)
