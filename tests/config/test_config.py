"""The configuration: one source for defaults, bounds and help; every mistake is named with the key and what would do."""

import dataclasses
import math
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamcli.config import toml
from slamcli.config.options import Config, option
from slamcli.errors import SlamError

CONFIGS = Path(__file__).parents[2] / "configs"


def options() -> list[tuple[str, dataclasses.Field]]:
    return [(f"{name}.{spec.name}", spec) for name, section in toml._sections().items() for spec in dataclasses.fields(section)]


def test_default_toml_is_what_the_dataclasses_say() -> None:
    expected = toml.dump(Config(), explain=True)
    assert (CONFIGS / "default.toml").read_text() == expected, "make it anew: slamcli config --defaults --explain > configs/default.toml"
    assert toml.read(CONFIGS / "default.toml") == Config()


@pytest.mark.parametrize("name", toml.shipped())
def test_every_shipped_configuration_is_valid(name: str) -> None:
    config = toml.resolve(None, name, [])
    assert (config == Config()) == (name == "default")


def test_fast_and_accurate_are_shipped() -> None:
    assert {"default", "fast", "accurate"} <= set(toml.shipped())


@pytest.mark.parametrize(("name", "spec"), options(), ids=[name for name, _ in options()])
def test_every_default_passes_its_own_check_and_has_help(name: str, spec: dataclasses.Field) -> None:
    assert toml.apply(Config(), [f"{name}={toml._toml(spec.default)}"]) == Config()
    assert len(spec.metadata["help"]) > 5


def test_dump_and_read_are_inverse(tmp_path: Path) -> None:
    config = toml.apply(Config(), ["seed=7", "track.min_inliers=31", "camera.fx=500", "camera.width=320", "match.vocabulary=/a b/ü.npz"])
    path = tmp_path / "config.toml"
    path.write_text(toml.dump(config))
    assert toml.read(path) == config
    path.write_text(toml.dump(config, explain=True))
    assert toml.read(path) == config


@given(st.text(max_size=40))
def test_any_text_survives_being_written(text: str) -> None:
    if "\x00" not in text and text.isprintable():
        assert tomllib.loads(f"x = {toml._toml(text)}") == {"x": text}


@given(st.text(max_size=30))
def test_any_assignment_is_taken_or_refused_in_one_line(text: str) -> None:
    try:
        taken = toml.apply(Config(), [f"track.min_inliers={text}"]).track.min_inliers
    except SlamError:
        return
    assert type(taken) is int
    assert taken >= 4


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("track.min_inlier=20", "track.min_inlier is not known; did you mean track.min_inliers?"),
        ("trck.min_inliers=20", "trck.min_inliers is not known; did you mean track.min_inliers?"),
        ("min_inliers=20", "min_inliers is not known; did you mean track.min_inliers or loop.min_inliers?"),
        ("qqq.zzz=1", "qqq.zzz is not known; see: slamcli.config.toml.known_keys()"),
        ("track.min_inliers=2", "must be >= 4, <= 20000 (fewer inliers: the frame is lost)"),
        ("track.min_inliers=4.5", "must be a whole number"),
        ("track.min_inliers=true", "must be a whole number"),
        ("track.min_inliers=many", "must be a whole number"),
        ("track.min_inliers=", "must be a whole number"),
        ("track.min_inliers=1\nseed=3", "must be a whole number"),
        ("extract.scale=nan", "must be a number, > 1.0, <= 2.0"),
        ("extract.scale=inf", "must be a number, > 1.0, <= 2.0"),
        ("extract.scale=1.0", "must be > 1.0"),
        ("loop.enabled=1", "must be true or false"),
        ("match.method=magic", "must be one of words, brute"),
        ("seed=-1", "must be >= 0"),
        ("seed=99999999999999999999", "seed=99999999999999999999: too large a number; must be a whole number, >= 0"),
        ("extract.features=1e9", "must be a whole number, >= 50, <= 20000"),
        ("extract.features=1000000000", "must be >= 50, <= 20000 (key points"),
        ("octree.resolution=1e-9", "must be >= 0.001, <= 10 (leaf side"),
        ("octree.resolution=" + "9" * 5000, "9...: "),
        ("seed", "write settings section.key=value"),
        ("=1", "write settings section.key=value"),
        ("track=1", "track is a section"),
        ("camera=1", "camera is a section"),
        ("camera.fz=1", "camera.fz is not known; did you mean camera.f"),
        ("camera.fx=wide", "must be a number"),
        ("camera.width=640.5", "must be a whole number"),
        ("track.min_inliers.x=1", "track.min_inliers.x is not known; did you mean track.min_inliers?"),
    ],
)
def test_a_wrong_assignment_names_the_key_and_what_would_do(assignment: str, message: str) -> None:
    with pytest.raises(SlamError) as caught:
        toml.apply(Config(), [assignment])
    assert str(caught.value).startswith("settings ")
    assert message in str(caught.value)


NUMBERS = {
    name: spec
    for name, spec in [*options(), *((spec.name, spec) for spec in dataclasses.fields(Config) if spec.name == "seed")]
    if type(spec.default) in (int, float) and not spec.metadata["choices"]
}
HUGE = (
    "1e9",
    "-1e9",
    "1e300",
    "-1e300",
    "1e-300",
    "-1",
    "1000000000",
    "-1000000000",
    "9" * 400,
    "9" * 5000,
    "nan",
    "inf",
    "-inf",
    "0",
    "0.0",
    "-0.0",
)


@pytest.mark.parametrize("name", NUMBERS)
def test_every_number_has_bounds_on_both_sides_and_what_lies_beyond_is_told_with_them(name: str) -> None:
    """So that no value asks for more memory or time than there is: what lies within bounds, scripts/extremes.py tries."""
    bounds = NUMBERS[name].metadata["bounds"]
    assert {"ge", "gt"} & bounds.keys() and {"le", "lt"} & bounds.keys(), "an option without a lower or an upper bound"
    assert all(math.isfinite(bound) for bound in bounds.values())
    told = toml._range(bounds)
    said = []
    for text in HUGE:
        try:
            config = toml.apply(Config(), [f"{name}={text}"])
        except SlamError as error:
            said.append(str(error))
        else:
            assert toml.parse(toml.dump(config).encode(), source="written") == config  # also the ranges that follow from it
    assert len(said) >= 8
    assert all(told in line and len(line) < 400 and "\n" not in line for line in said)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[track]\nmin_inlier = 20\n", "track.min_inlier is not known; did you mean track.min_inliers?"),
        ("[track]\nmin_inliers = 2\n", "track.min_inliers = 2: must be >= 4"),
        ("[trak]\nmin_inliers = 20\n", "trak.min_inliers is not known; did you mean track.min_inliers?"),
        ("track = 3\n", "track is a section"),
        ("[track\n", "not valid TOML"),
        ("x = " + "[" * 100000, "not valid TOML"),
        ("\udcff", "not valid TOML"),
        ("#" * (1 << 20) + "\n", "too large"),
    ],
)
def test_a_wrong_file_is_named_with_the_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(SlamError) as caught:
        toml.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_an_absent_file_is_named() -> None:
    with pytest.raises(SlamError, match="mine.toml: cannot be read"):
        toml.read(Path("mine.toml"))
    with pytest.raises(SlamError, match="configuration quick: neither a file nor one of accurate, default, fast, robot"):
        toml.resolve(None, "quick", [])


def test_precedence_is_defaults_then_file_then_assignments(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[extract]\nfeatures = 700\nlevels = 5\n")
    base = toml.apply(Config(), ["extract.cell=33"])
    assert toml.resolve(base, None, ["extract.levels=6"]).extract == dataclasses.replace(Config().extract, cell=33, levels=6)
    assert toml.resolve(base, str(path), ["extract.levels=6"]).extract == dataclasses.replace(Config().extract, features=700, levels=6)


def test_a_file_option_becomes_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert toml.apply(Config(), ["match.vocabulary=words.npz"]).match.vocabulary == str(tmp_path / "words.npz")


def test_lists_are_checked_item_by_item() -> None:
    @dataclasses.dataclass(frozen=True)
    class Section:
        size: tuple[float, float] = option((1.0, 2.0), "width and height [m]")
        levels: tuple[int, ...] = option((), "some levels")

    def value(key: str, given: object) -> object:
        return toml._value(Section, "box", key, given, "mine.toml")

    assert value("size", [3, 4.5]) == (3.0, 4.5)
    assert value("levels", [1, 2, 3]) == (1, 2, 3)
    for key, wrong, message in (("size", [1], "a list of 2"), ("size", 1.0, "a list in"), ("levels", [1, 2.5], "a whole number")):
        with pytest.raises(SlamError, match=message):
            value(key, wrong)


def test_explain_shows_unit_and_bounds_of_what_is_asked() -> None:
    text = toml.dump(Config(), explain=True, only=["track.min_inliers", "sensor"])
    assert "# fewer inliers: the frame is lost; >= 4, <= 20000\nmin_inliers = 15" in text
    assert "[sensor]" in text
    assert "[extract]" not in text
    with pytest.raises(SlamError, match="did you mean"):
        toml.dump(Config(), only=["track.min_inlier"])


@pytest.mark.parametrize(("name", "spec"), options(), ids=[name for name, _ in options()])
def test_a_help_text_is_short_and_stands_alone(name: str, spec: dataclasses.Field) -> None:
    words = spec.metadata["help"].split()
    assert len(words) <= 15, f"{name}: {len(words)} words"
    assert words[0] not in {"and", "or", "its", "such", "those", "unless", "then"}, f"{name} needs the option before it to be understood"


def test_what_is_changed_is_told_with_its_default() -> None:
    config = toml.apply(Config(), ["track.min_inliers=20", "seed=3", "camera.fx=500"])
    assert toml.changed(config) == ["seed", "track.min_inliers", "camera"]
    assert toml.changed(Config()) == []
    text = toml.dump(config, only=toml.changed(config), with_defaults=True)
    assert "seed = 3  # default: 0\n" in text
    assert "min_inliers = 20  # default: 15\n" in text
    assert "fx = 500.0" in text
    assert toml.merge(Config(), tomllib.loads(text), source="text") == config


def test_options_are_found_by_a_word_of_their_name_or_help() -> None:
    found = toml.find_options(["floor"])
    assert "ground.min_patches" in found and "grid2d.extend_down" in found
    assert "extract.levels" not in found
    assert toml.find_options(["track", "seed", "octree.stride"]) == ["track", "seed", "octree.stride"]
    with pytest.raises(SlamError, match="frobnicate is not known"):
        toml.find_options(["frobnicate"])


def test_explain_tells_what_fast_and_accurate_change() -> None:
    text = toml.dump(Config(), explain=True, only=["extract.features"])
    assert "accurate: 1500, fast: 600" in text
