#!/usr/bin/env python
"""Write the reference pages of options and of artefacts from the dataclasses that declare them.

    python scripts/reference.py [--check]

docs/options.md and docs/artefacts.md are overwritten; with --check nothing is, and the exit status says whether they are up to date.
"""

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from slamcli import schema
from slamcli.config.options import Config
from slamcli.stages import STAGES

DOCS = Path(__file__).resolve().parents[1] / "docs"
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
    yield "A stage whose sections have changed is stale; no other is.\n"
    for spec in dataclasses.fields(Config):
        section = getattr(Config(), spec.name)
        if not dataclasses.is_dataclass(section):
            continue
        used = [stage.name for stage in STAGES if spec.name in stage.config]
        yield f"## {spec.name}\n\n{(type(section).__doc__ or '').strip()}"
        yield f"Read by {', '.join(used)}.\n" if used else "Read by no stage: it changes no result.\n"
        yield "| option | default | allowed | meaning |\n|---|---|---|---|"
        for field in dataclasses.fields(section):
            yield f"| `{field.name}` | `{_value(getattr(section, field.name))}` | {_allowed(field)} | {_cell(field.metadata['help'])} |"
        yield ""


def artefacts_page() -> Iterator[str]:
    """Return the lines of the page of artefacts."""
    yield f"# Artefacts\n\n{NOTE}"
    yield "Beside the standard files, a stage's folder holds one plain `.npy` file an array. The names are those of the fields below; `numpy.load` reads each."
    yield f"This is format {schema.FORMAT}; a run of another one is told to run again. {_sentence(schema.__doc__)}\n"
    for record in _records():
        yield f"## {record.__name__}\n\n{(record.__doc__ or '').strip()}\n"
        yield "| array | type | shape | meaning |\n|---|---|---|---|"
        for field in dataclasses.fields(record):
            shape = " x ".join(field.metadata["shape"]) or "scalar"
            yield f"| `{field.name}` | {field.metadata['dtype']} | {shape} | {_cell(field.metadata['meaning'])} |"
        yield ""


def _records() -> list[type]:
    return [value for value in vars(schema).values() if dataclasses.is_dataclass(value) and isinstance(value, type)]


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
