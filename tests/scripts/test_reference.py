"""The reference pages say what the code declares."""

import importlib.util
from pathlib import Path

from slamcli.config.options import Config
from slamcli.schema import Features

ROOT = Path(__file__).parents[2]


def script():
    spec = importlib.util.spec_from_file_location("reference", ROOT / "scripts" / "reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_are_up_to_date():
    for path, text in script().pages().items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name} is stale; run: python scripts/reference.py"


def test_every_option_and_every_array_has_a_line():
    options, artefacts = ("\n".join(lines()) for lines in (script().options_page, script().artefacts_page))
    for section in (Config().track, Config().grid2d):
        assert all(f"| `{name}` |" in options for name in vars(section))
    assert all(f"| `{name}` |" in artefacts for name in Features.__dataclass_fields__)
