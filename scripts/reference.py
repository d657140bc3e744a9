#!/usr/bin/env python
"""Write the reference pages of options and of artefacts from the dataclasses that declare them.

    python scripts/reference.py [--check]

docs/options.md and docs/artefacts.md are overwritten; with --check nothing is, and the exit status says whether they are up to date.
"""

import argparse
import dataclasses
import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from slamcli import schema
from slamcli.config.options import Config
from slamcli.geometry.camera import Camera
from slamcli.stages import STAGES

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAPERS = "[Z] and [L] are the two papers, and numbers in parentheses their equations: see [The method](method.md)."
# Which sections are read by something else than stages.
READ_BY = {
    "run": "Read by no stage: it changes no result.",
    "recording": "Read when the recording is opened: with another value it is another recording, and every stage is stale.",
    "robot": "Read by `plan` and `export-grid`, by no stage: it changes no result of a run.",
}
TRY_FIRST = {
    "extract.features": "more points where few are found, fewer for speed",
    "sensor.depth_max": "a camera that measures well only to 3 m, or to 10 m",
    "track.min_inliers": "frames are lost, or wrong poses are accepted",
    "track.segment_after": "tracking begins anew too soon, or never",
    "loop.min_inliers": "a loop is not closed, or a wrong one is",
    "optimize.intrinsics": "the calibration is a guess",
    "densify.voxel": "a finer or a coarser cloud",
    "octree.resolution": "a finer or a coarser octree",
    "grid2d.band_high": "the height of your robot",
    "seed": "does a result depend on chance?",
}
NOTE = "<!-- written by scripts/reference.py from the code: change the help there -->\n"


def main() -> int:
    """Write the pages, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args().check
    stale = []
    for path, text in pages().items():
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            stale.append(path.name)
            if not check:
                path.write_text(text, encoding="utf-8")
    print(f"{'stale' if check else 'written'}: {', '.join(stale) or 'nothing'}")
    return 1 if check and stale else 0


def pages() -> dict[Path, str]:
    """Return the text of each page."""
    return {
        DOCS / "options.md": "\n".join(options_page()) + "\n",
        DOCS / "artefacts.md": "\n".join(artefacts_page()) + "\n",
    }


def options_page() -> Iterator[str]:
    """Return the lines of the page of options."""
    yield f"# Options\n\n{NOTE}"
    yield "Set one with `-s section.option=value` on `run` and on each stage's command, or in a TOML file given with `--config`."
    yield f"A stage whose sections have changed is stale; no other is. {PAPERS}\n"
    yield from _first_tries()
    yield "## seed and camera\n\nThese belong to no section of the tables below.\n"
    yield "| option | default | allowed | meaning |\n|---|---|---|---|"
    yield _row("seed", Config().seed, _field("seed"))
    keys = ", ".join(f"`{field.name}`" for field in dataclasses.fields(Camera))
    yield f"| `camera.<key>` | the recording's | {keys} | overrides a number of the recording's calibration, as in `camera.toml`; read by extract |\n"
    for spec in dataclasses.fields(Config):
        section = getattr(Config(), spec.name)
        if not dataclasses.is_dataclass(section):
            continue
        used = [stage.name for stage in STAGES if spec.name in stage.config]
        yield f"## {spec.name}\n\n{(type(section).__doc__ or '').strip()}"
        yield (f"Read by {', '.join(used)}." if used else READ_BY[spec.name]) + "\n"
        yield "| option | default | allowed | meaning |\n|---|---|---|---|"
        for field in dataclasses.fields(section):
            yield _row(field.name, getattr(section, field.name), field)
        yield ""


def _first_tries() -> Iterator[str]:
    yield "## Ten options to try first\n\n| option | default | when |\n|---|---|---|"
    for name, reason in TRY_FIRST.items():
        value = Config()
        for part in name.split("."):
            value = getattr(value, part)
        yield f"| `{name}` | `{_value(value)}` | {reason} |"
    yield ""


def _row(name: str, default: Any, field: dataclasses.Field) -> str:
    return f"| `{name}` | `{_value(default)}` | {_allowed(field)} | {_cell(field.metadata['help'])} |"


def _field(name: str) -> dataclasses.Field:
    return next(field for field in dataclasses.fields(Config) if field.name == name)


def artefacts_page() -> Iterator[str]:
    """Return the lines of the page of artefacts."""
    yield f"# Artefacts\n\n{NOTE}"
    yield "Beside the standard files, a stage's folder holds one plain `.npy` file per array, named as the fields below; `numpy.load` reads each."
    yield f"This is format {schema.FORMAT}; a run of another format has to be made again. {_sentence(schema.__doc__)} {PAPERS}\n"
    for record in _records():
        yield f"## {record.__name__}\n\n{inspect.getdoc(record)}\n"
        yield "| array | type | shape | meaning |\n|---|---|---|---|"
        for field in dataclasses.fields(record):
            shape = " x ".join(field.metadata["shape"]) or "scalar"
            kinds = " or ".join(str(kind) for kind in (*field.metadata["narrow"], field.metadata["dtype"]))
            yield f"| `{field.name}` | {kinds} | {shape} | {_cell(field.metadata['meaning'])} |"
        yield ""


def _records() -> list[type]:
    """List the records that stages write as arrays; a Trajectory is a text file, and Values says what arrays may hold."""
    found = [value for value in vars(schema).values() if dataclasses.is_dataclass(value) and isinstance(value, type)]
    return [record for record in found if record not in (schema.Trajectory, schema.Values)]


def _sentence(text: str | None) -> str:
    """Return the notes of the module's docstring, from the second paragraph on, in one line."""
    return " ".join((text or "").partition("\n\n")[2].split())


def _value(value: Any) -> str:
    return {True: "true", False: "false", "": '""'}[value] if isinstance(value, bool) or value == "" else str(value)


def _allowed(field: dataclasses.Field) -> str:
    if field.metadata["choices"]:
        return ", ".join(f"`{choice}`" for choice in field.metadata["choices"])
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    return ", ".join(f"{signs[name]} {bound}" for name, bound in field.metadata["bounds"].items())


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    sys.exit(main())
