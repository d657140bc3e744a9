"""Rows of figures as aligned text, CSV or LaTeX."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

from slamcli import console

LATEX_SPECIAL = {"&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}"}
LATEX_SPECIAL |= {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}

Columns = Mapping[str, tuple[str, str]]  # key of a row -> heading, format specification ("" for text)


def render(rows: Sequence[Mapping[str, Any]], columns: Columns, style: str) -> str:
    """Render rows in a `style` of "text", "csv" (full precision, keys as headings) or "latex" (booktabs)."""
    return {"text": _text, "csv": _csv, "latex": _latex}[style](rows, columns)


def _cell(value: Any, specification: str) -> str:
    if value is None:
        return "-"
    return format(value, specification) if specification else str(value)


def _cells(rows: Sequence[Mapping[str, Any]], columns: Columns) -> list[list[str]]:
    return [[_cell(row[key], specification) for key, (_, specification) in columns.items()] for row in rows]


def _text(rows: Sequence[Mapping[str, Any]], columns: Columns) -> str:
    numbers = [k for k, (_, specification) in enumerate(columns.values()) if specification]
    return console.table([[heading for heading, _ in columns.values()], *_cells(rows, columns)], right=numbers)


def _csv(rows: Sequence[Mapping[str, Any]], columns: Columns) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([["" if row[key] is None else row[key] for key in columns] for row in rows])
    return buffer.getvalue().rstrip("\n")


def _latex(rows: Sequence[Mapping[str, Any]], columns: Columns) -> str:
    alignment = "".join("l" if specification == "" else "r" for _, specification in columns.values())
    lines = [[heading for heading, _ in columns.values()], *_cells(rows, columns)]
    escaped = [" & ".join("".join(LATEX_SPECIAL.get(letter, letter) for letter in cell) for cell in line) + r" \\" for line in lines]
    return "\n".join(
        [rf"\begin{{tabular}}{{{alignment}}}", r"\toprule", escaped[0], r"\midrule", *escaped[1:], r"\bottomrule", r"\end{tabular}"]
    )
