"""What the documents tell a user to type and to write is what the program takes."""

import ast
import re
import shlex
import textwrap
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

import slamcli
from slamcli.cli.main import cli
from slamcli.config import toml
from slamcli.config.options import Config
from slamcli.datasets import READERS
from slamcli.formats import TRAJECTORY_FORMATS, cloud, mesh
from slamcli.geometry.camera import Camera

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK, COMMAND = re.compile(r"^ *```\w*\n(.*?)^ *```", re.M | re.S), re.compile(r"^\s*(?:\$ )?(slamcli [^\n]*)$", re.M)
INLINE = re.compile(r"`(slamcli [^`]*)`")
PLACE = re.compile(r"(?<![\w/])(?:slamcli/)?((?:[a-z_0-9]+/)+[a-z_0-9]+)\.([A-Za-z_]\w*)(?:\.(\w+))?")


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


def test_what_the_documents_give_to_launch_is_python() -> None:
    found = re.findall(r"^   ```python\n(.*?)^   ```", (ROOT / "docs" / "robot.md").read_text(encoding="utf-8"), re.M | re.S)
    nodes = [node for block in found for node in ast.walk(ast.parse(textwrap.dedent(block))) if isinstance(node, ast.Call)]
    packages = [word.value.value for node in nodes for word in node.keywords if word.arg == "package"]
    assert packages[:2] == ["nav2_map_server", "nav2_amcl"] and {"pointcloud_to_laserscan", "depthimage_to_laserscan"} < set(packages)


def test_every_layout_that_opens_has_a_row() -> None:
    page = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    for reader in READERS:
        assert re.search(r"[\w-]{3,}", reader.title).group() in page, f"a row for {reader.title}"


def test_every_ending_that_is_written_is_told() -> None:
    rows = {
        words[1].strip(): line
        for line in (ROOT / "docs" / "exports.md").read_text(encoding="utf-8").splitlines()
        if len(words := line.split("|")) > 3
    }
    trajectory = [ending for endings in TRAJECTORY_FORMATS.values() for ending in endings]
    for what, endings in {
        "trajectory": trajectory,
        "cloud": cloud.WRITERS,
        "surface": mesh.WRITERS,
        "textured surface": mesh.TEXTURE_WRITERS,
    }.items():
        assert all(f"`{ending}`" in rows[what] for ending in endings), what
    told = CliRunner().invoke(cli, ["export-trajectory", "--help"]).output
    assert all(ending in told for ending in trajectory)


def names_in(body: list[ast.stmt]) -> dict[str, ast.stmt]:
    return {node.name: node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}


def places(page: Path) -> list[tuple[str, str, str]]:
    """Return each file of the package that a page names, what it names in it, and what within that."""
    found = PLACE.findall(page.read_text(encoding="utf-8"))
    return [place for place in found if (ROOT / "slamcli" / place[0].split("/")[0]).is_dir()]


def test_the_method_names_functions_enough_to_follow_it() -> None:
    assert len({place for place in places(ROOT / "docs" / "method.md") if place[1] != "py"}) > 50


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_every_file_and_function_that_the_documents_name_is_there(page: Path) -> None:
    for name, what, within in places(page):
        file = ROOT / "slamcli" / f"{name}.{what if what in ('css', 'html', 'js', 'toml') else 'py'}"
        assert file.is_file(), f"{page.name}: {file}"
        if file.suffix == ".py" and what != "py":
            there = names_in(ast.parse(file.read_text(encoding="utf-8")).body)
            assert what in there, f"{page.name}: {name}.{what}"
            assert not within or within in names_in(there[what].body), f"{page.name}: {name}.{what}.{within}"


def test_the_glossary_explains_each_word_once() -> None:
    _, _, words = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8").partition("\n## ")[0].partition("|---|---|")
    names = [name for row in re.findall(r"^\| ([^|]+) \|", words, re.M) for name in row.split(", ")]
    assert len(names) > 20 and [name for name in names if names.count(name) > 1] == []


def test_the_glossary_explains_every_count_of_every_stage(room_run: Path) -> None:
    explained: dict[str, set[str]] = {}
    stage = ""
    for row in re.findall(r"^\| (\w*) ?\| ([^|]+) \|", (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"), re.M):
        stage = row[0] or stage
        explained.setdefault(stage, set()).update(row[1].split(", "))
    for name, summary in slamcli.open_run(room_run).summary().items():
        counted = {count.replace("_", " ") for count in summary} - {"frames"}
        assert counted <= explained.get(name, set()), f"{name}: {sorted(counted - explained[name])}"
