"""The configuration as text: TOML files and `-s section.key=value`, merged over the defaults and checked against the declarations."""

import dataclasses
import difflib
import functools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from slamcli import files
from slamcli.config import ranges
from slamcli.config.options import Config
from slamcli.errors import SlamError
from slamcli.hints import hint

Settings = Mapping[str, Any] | Iterable[str]  # values by full name, or the texts that follow -s

LARGEST_FILE = 1 << 20  # bytes; ours have about ten thousand
LARGEST_NUMBER = 1 << 62  # of a whole number: what arrays can hold
LONGEST_SHOWN = 80  # characters of a key or a value in a message
COMPARISONS = {
    "ge": (">=", lambda value, bound: value >= bound),
    "gt": (">", lambda value, bound: value > bound),
    "le": ("<=", lambda value, bound: value <= bound),
    "lt": ("<", lambda value, bound: value < bound),
}
KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: 'a text in "quotes"'}


def shipped() -> list[str]:
    """List the configurations that come with slamcli, by name."""
    return sorted(path.stem for path in _shipped_folder().glob("*.toml"))


def _shipped_folder() -> Path:
    """Find `configs/`: an installed package carries it inside, a checkout beside the package."""
    package = Path(__file__).parents[1]
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def find(name_or_file: str) -> Path:
    """Find a configuration: a file, else one of `shipped()` by its name."""
    path = files.user_path(name_or_file)
    if path.is_file():
        return path
    if name_or_file in shipped():
        return _shipped_folder() / f"{name_or_file}.toml"
    raise SlamError(f"configuration {name_or_file}: neither a file nor one of {', '.join(shipped())}")


def read(path: Path, base: Config | None = None) -> Config:
    """Merge a TOML file over `base` (the defaults); SlamError names the file and the key at fault."""
    try:
        text = files.read_bytes(path, limit=LARGEST_FILE)
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror})") from error
    return parse(text, base, source=str(path))


def parse(text: bytes, base: Config | None = None, *, source: str) -> Config:
    """Merge TOML over `base` (the defaults); SlamError names `source` and the key at fault."""
    return merge(base or Config(), files.parse_toml(text, source=source), source=source)


def merge(base: Config, values: Mapping[str, Any], *, source: str) -> Config:
    """Lay nested `values` over `base`; SlamError names `source` and the key at fault. Ranges follow the sensor's reach, see `ranges`."""
    changes: dict[str, Any] = {}
    for name, value in values.items():
        if name == "camera" and isinstance(value, Mapping):
            changes[name] = base.camera | {key: _camera_value(key, v, source) for key, v in value.items()}
        elif name in _sections() and isinstance(value, Mapping):
            section = getattr(base, name)
            changes[name] = dataclasses.replace(section, **{key: _value(type(section), name, key, v, source) for key, v in value.items()})
        elif name == "camera" or name in _sections():
            raise SlamError(f"{source}: {name} is a section; write {name}.KEY=VALUE or a table [{name}]")
        elif isinstance(value, Mapping) and value:
            raise _unknown(f"{name}.{next(iter(value))}", source)
        else:
            changes[name] = _value(Config, "", name, value, source)
    given = {f"{name}.{key}" for name, value in values.items() if isinstance(value, Mapping) for key in value}
    return ranges.follow(base, dataclasses.replace(base, **changes), given)


def apply(base: Config, assignments: Iterable[str]) -> Config:
    """Lay the `-s section.key=value` of a command over `base`. A value is read as TOML, and as plain text where it is not TOML."""
    for assignment in assignments:
        key, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals or not key:
            given = hint().argument("settings")
            raise SlamError(f"{given} {assignment}: write {given} section.key=value, such as track.min_inliers=20")
        values: Any = _parse(text)
        for part in reversed(key.split(".", 1)):
            values = {part: values}
        shown = assignment if len(assignment) <= LONGEST_SHOWN else f"{assignment[:LONGEST_SHOWN]}..."
        base = merge(base, values, source=f"{hint().argument('settings')} {shown}")
    return base


def _parse(text: str) -> Any:
    try:
        parsed = files.parse_toml(f"value = {text}".encode(errors="replace"), source=text)
    except SlamError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


def resolve(base: Config | None, name_or_file: str | None, settings: Settings) -> Config:
    """Return the configuration of a command: `base` (a run's own, or the defaults) unless a configuration is named, then each setting."""
    config = base or Config()
    if name_or_file:
        config = read(find(name_or_file))
    return set_options(config, settings) if isinstance(settings, Mapping) else apply(config, settings)


def set_options(base: Config, values: Mapping[str, Any]) -> Config:
    """Lay values by their full names over `base`, such as ``{"track.min_inliers": 20, "seed": 1}``."""
    for key, value in values.items():
        section, dot, option = key.partition(".")
        base = merge(base, {section: {option: value} if dot else value}, source="settings")
    return base


def _sections() -> dict[str, Any]:
    return {spec.name: spec.default_factory for spec in dataclasses.fields(Config) if _is_section(spec)}


def _is_section(spec: dataclasses.Field) -> bool:
    return spec.default_factory is not dataclasses.MISSING and dataclasses.is_dataclass(spec.default_factory)


def _camera_keys() -> list[str]:
    from slamcli.geometry.camera import Camera

    return [spec.name for spec in dataclasses.fields(Camera)]


def choices(name: str) -> list[str]:
    """List the values that an option may have, where these can be listed; its full name is given."""
    section, _, key = name.partition(".")
    spec = next((spec for spec in dataclasses.fields(_sections().get(section, Config)) if spec.name == key), None)
    if spec is None or "choices" not in spec.metadata:
        return []
    return ["true", "false"] if isinstance(spec.default, bool) else [str(value) for value in spec.metadata["choices"]]


def known_keys() -> list[str]:
    """List every option by its full name."""
    keys = [spec.name for spec in dataclasses.fields(Config) if spec.name != "camera" and not _is_section(spec)]
    keys += [f"camera.{key}" for key in _camera_keys()]
    return keys + [f"{name}.{spec.name}" for name, section in _sections().items() for spec in dataclasses.fields(section)]


def _unknown(key: str, source: str) -> SlamError:
    """Build the error for a key nobody declared, with those that may be meant: the same option of a section, else the nearest name."""
    known = known_keys()
    near = [name for name in known if name.rpartition(".")[2] == key.rpartition(".")[2]]
    if "." in key:
        near = difflib.get_close_matches(key, near, n=1, cutoff=0.0)
    near = near or difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    advice = f"did you mean {' or '.join(near)}?" if near else f"see: {hint().options()}"
    return SlamError(f"{source}: {key[:LONGEST_SHOWN]} is not known; {advice}")


def _camera_value(key: str, value: Any, source: str) -> float | str:
    if key not in _camera_keys():
        raise _unknown(f"camera.{key}", source)
    expected = {"width": int, "height": int, "lens": str}.get(key, float)
    return _typed(expected, value, _origin(f"camera.{key}", value, source))


@functools.cache
def _hints(section: type) -> dict[str, Any]:
    """Evaluate the types of a section's options; each option of each configuration asks for them."""
    return get_type_hints(section)


def _value(section: type, section_name: str, key: str, value: Any, source: str) -> Any:
    """Check one value against its declaration and give it in the declared type."""
    name = f"{section_name}.{key}" if section_name else key
    spec = next((spec for spec in dataclasses.fields(section) if spec.name == key and spec.name != "camera"), None)
    if spec is None or _is_section(spec):
        raise _unknown(name, source)
    origin, meta = _origin(name, value, source), spec.metadata
    allowed = _range(meta["bounds"])
    value = _typed(_hints(section)[key], value, origin, allowed)
    if not all(COMPARISONS[bound][1](value, limit) for bound, limit in meta["bounds"].items()):
        raise SlamError(f"{origin}: must be {allowed} ({meta['help']})")
    if meta["choices"] and value not in meta["choices"]:
        raise SlamError(f"{origin}: must be one of {', '.join(map(str, meta['choices']))} ({meta['help']})")
    if meta["is_file"] and value:
        value = str(files.user_path(value).resolve())
    return value


def _origin(name: str, value: Any, source: str) -> str:
    if source.startswith(f"{hint().argument('settings')} "):  # an assignment, which says it all
        return source
    try:
        shown = _toml(value)
    except (ValueError, RecursionError):  # thousands of digits, or of brackets
        shown = "..."
    return f"{source}: {name} = {shown if len(shown) <= LONGEST_SHOWN else shown[:LONGEST_SHOWN] + '...'}"


def _range(bounds: Mapping[str, Any]) -> str:
    """Write an option's bounds as ">= 4, <= 20000"; "" without any."""
    return ", ".join(f"{COMPARISONS[bound][0]} {limit}" for bound, limit in bounds.items())


def _typed(expected: Any, value: Any, origin: str, allowed: str = "") -> Any:
    if get_origin(expected) is tuple:
        return _typed_tuple(get_args(expected), value, origin)
    kind = ", ".join(filter(None, (KINDS[expected], allowed)))
    if isinstance(value, int) and abs(value) > LARGEST_NUMBER:
        raise SlamError(f"{origin}: too large a number; must be {kind}")
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not expected or (expected is float and not math.isfinite(value)):
        raise SlamError(f"{origin}: must be {kind}")
    return value


def _typed_tuple(expected: tuple, value: Any, origin: str) -> tuple:
    if not isinstance(value, (list, tuple)):
        raise SlamError(f"{origin}: must be a list in [brackets]")
    if expected[-1] is Ellipsis:
        expected = expected[:1] * len(value)
    if len(value) != len(expected):
        raise SlamError(f"{origin}: must be a list of {len(expected)}")
    return tuple(_typed(kind, item, origin) for kind, item in zip(expected, value, strict=True))


def changed(config: Config) -> list[str]:
    """List the full names of the options that differ from the defaults, and camera where anything of it is overridden."""
    defaults = Config()
    names = [name for name in known_keys() if not name.startswith("camera.") and _get(config, name) != _get(defaults, name)]
    return names + (["camera"] if config.camera else [])


def _get(config: Config, name: str) -> Any:
    section, dot, key = name.partition(".")
    return getattr(getattr(config, section), key) if dot else getattr(config, section)


def find_options(words: Sequence[str]) -> list[str]:
    """List what `config --explain` is asked for: sections and options by name, else those whose name or help has the word.

    Raises SlamError for a word that occurs nowhere, with the option that may be meant.
    """
    found: list[str] = []
    for word in words:
        if word in _sections() or word in known_keys() or word == "camera":
            found.append(word)
            continue
        hits = [name for name, help_text in _help().items() if word.lower() in name.lower() or word.lower() in help_text.lower()]
        if not hits:
            raise _unknown(word, "config")
        found += hits
    return found


def _help() -> dict[str, str]:
    """Return the help of every option by its full name."""
    plain = {spec.name: spec.metadata["help"] for spec in dataclasses.fields(Config) if "help" in spec.metadata}
    return plain | {
        f"{name}.{spec.name}": spec.metadata["help"] for name, section in _sections().items() for spec in dataclasses.fields(section)
    }


def dump(config: Config, *, explain: bool = False, only: Sequence[str] = (), with_defaults: bool = False) -> str:
    """Write every value as TOML that `read` takes back.

    explain : put each option's help, bounds and choices above it
    with_defaults : tell in a comment what the default is, where a value differs from it
    only : sections ("track") and options ("track.min_inliers") to write; all of them when empty
    """
    _check_known(only)
    told = Told(explain=explain, with_defaults=with_defaults)
    blocks = [_block("", Config, config, told, only)]
    blocks += [_block(name, section, getattr(config, name), told, only) for name, section in _sections().items()]
    if not only or any(name.partition(".")[0] == "camera" for name in only):
        values = [f"{key} = {_toml(config.camera[key])}" for key in _camera_keys() if key in config.camera]
        blocks.append(["[camera]  # overrides the recording's calibration; keys: " + " ".join(_camera_keys()), *values])
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def to_dict(config: Config, only: Sequence[str] | None = None) -> dict[str, Any]:
    """Return the values as plain ones, by section.

    only : sections ("track") and options ("track.min_inliers") to return; all of them when None
    """
    values = dataclasses.asdict(config)
    if only is None:
        return values
    _check_known(only)
    chosen: dict[str, Any] = {}
    for name in only:
        section, _, key = name.partition(".")
        if key:
            chosen.setdefault(section, {})[key] = values[section].get(key)
        else:
            chosen[section] = values[section]
    return chosen


def _check_known(only: Sequence[str]) -> None:
    for name in only:
        if name not in known_keys() and name not in _sections() and name != "camera":
            raise _unknown(name, "config")


@dataclasses.dataclass(frozen=True)
class Told:
    """What is told of an option beside its value."""

    explain: bool
    with_defaults: bool

    @functools.cached_property
    def presets(self) -> dict[str, Config]:
        """Return the shipped configurations that differ from the defaults."""
        return {name: read(_shipped_folder() / f"{name}.toml") for name in shipped() if name != "default"}

    def lines(self, name: str, spec: dataclasses.Field, value: Any) -> Iterator[str]:
        """Write an option as TOML, with what is to be told of it in comments."""
        if self.explain:
            meta = spec.metadata
            notes = [_range(meta["bounds"])] if meta["bounds"] else []
            notes += [" | ".join(map(str, meta["choices"]))] if meta["choices"] else []
            notes += [
                f"{preset}: {_toml(_get(config, name))}" for preset, config in self.presets.items() if _get(config, name) != spec.default
            ]
            yield f"# {meta['help']}" + (f"; {', '.join(notes)}" if notes else "")
        default = f"  # default: {_toml(spec.default)}" if self.with_defaults and value != spec.default else ""
        yield f"{spec.name} = {_toml(value)}{default}"


def _block(name: str, section: type, values: Any, told: Told, only: Sequence[str]) -> list[str]:
    """Write the options of one section that are wanted, under its heading."""
    lines: list[str] = []
    for spec in dataclasses.fields(section):
        key = f"{name}.{spec.name}" if name else spec.name
        if spec.name != "camera" and not _is_section(spec) and (not only or name in only or key in only):
            lines += told.lines(key, spec, getattr(values, spec.name))
    return [f"[{name}]  # {_first_line(section)}", *lines] if lines and name else lines


def _first_line(section: type) -> str:
    return (section.__doc__ or "").strip().splitlines()[0]


def as_text(value: Any) -> str:
    """Write a value as TOML, or a dash where there is none."""
    return "-" if value is None else _toml(value)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        return '"' + "".join(_escaped(character) for character in value) + '"'
    return repr(value)


def _escaped(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    return character if character.isprintable() else f"\\U{ord(character):08X}"
