"""A number that something measured is compared with has a name, a unit and a reason at the top of its file, or is an option."""

import ast
from pathlib import Path

import pytest

import slamcli

PACKAGE = Path(slamcli.__file__).parent
ROOMS = (
    "estimation",
    "geometry",
    "calibration",
    "datasets",
    "depth",
    "sparse_map",
    "dense",
    "navigation",
    "slam",
    "stages",
    "runs",
    "evaluation",
    "vision",
)
POLYNOMIALS = {"elementary.py"}  # whose constants are those of the functions' approximations, as fdlibm has them
FILES = sorted(path for room in ROOMS for path in (PACKAGE / room).rglob("*.py") if not {"simulated", *POLYNOMIALS} & set(path.parts))
PLAIN = {0.0, 0.5, 1.0, -1.0, 2.0, 4.0}  # halves, signs, and powers of two of sizes
GUARD = 1e-5  # smaller numbers keep a division or a root from 0


def bare(text: str) -> list[str]:
    """List the comparisons with a bare fraction."""
    return [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Compare)
        for part in ast.walk(node)
        if isinstance(part, ast.Constant) and type(part.value) is float and part.value not in PLAIN and abs(part.value) >= GUARD
    ]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_threshold_stands_bare_in_a_condition(path: Path) -> None:
    assert bare(path.read_text(encoding="utf-8")) == []


def test_a_bare_threshold_is_seen() -> None:
    assert bare("x = error < 0.3") == ["line 1: error < 0.3"]
    assert bare("x = error < LARGEST or length > 1e-9 or share < 0.5") == []
