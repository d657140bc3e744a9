"""Which tests show what an option does, and whether they would miss it: with the option disconnected such a test must fail."""

import ast
import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from slamcli.config.options import Config

TESTS = Path(__file__).parent
MARK = "pytest.mark.shows"
_missed: dict[str, bool] = {}


def names() -> list[str]:
    """List all options by their full names; the keys of `camera` are one."""
    fields = [(spec.name, getattr(Config(), spec.name)) for spec in dataclasses.fields(Config)]
    return [
        name
        for first, value in fields
        for name in ([f"{first}.{spec.name}" for spec in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else [first])
    ]


def shown() -> Iterator[tuple[str, str, str]]:
    """List from the sources what is marked: option, test, and the test's text without the mark."""
    for path in sorted(TESTS.rglob("test_*.py")):
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(function, ast.FunctionDef):
                marks = [node for line in function.decorator_list for node in ast.walk(line) if is_mark(node)]
                text = ast.unparse(function)
                for mark in marks:
                    text = text.replace(ast.unparse(mark), "")
                for mark in marks:
                    yield from ((ast.literal_eval(name), f"{path.name}::{function.name}", text) for name in mark.args)


def is_mark(node: ast.AST) -> bool:
    """Say whether a node of a source marks a test."""
    return isinstance(node, ast.Call) and ast.unparse(node.func) == MARK


def mentions(text: str, name: str) -> bool:
    """Say whether a test's text names an option."""
    return re.search(rf"\b{name.rpartition('.')[2]}\b", text) is not None


def shown_by(item: pytest.Item) -> list[str]:
    """List the options that a collected test shows."""
    return [name for mark in item.iter_markers("shows") for name in mark.args]


class _Fixed:
    """An attribute of a section that has its default whatever it is set to."""

    def __init__(self, default: object) -> None:
        self._default = default

    def __get__(self, owner: object, kind: type | None = None) -> object:
        return self._default

    def __set__(self, owner: object, value: object) -> None:
        pass


def is_missed(name: str, test: Callable[[], object]) -> bool:
    """Say whether a test fails while an option has its default, whatever it is set to."""
    section, _, key = name.rpartition(".")
    kind = type(getattr(Config(), section)) if section else Config
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kind, key, _Fixed(getattr(kind(), key)), raising=False)
        try:
            test()
        except (Exception, pytest.fail.Exception):
            return True
    return False


def note(name: str, *, is_missed: bool) -> None:
    """Remember that a test missed an option, or did not: of several, and of several parameters, one must."""
    _missed[name] = _missed.get(name, False) or is_missed


def not_missed() -> list[str]:
    """List the options whose tests all passed without them."""
    return sorted(name for name, missed in _missed.items() if not missed)
