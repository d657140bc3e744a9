"""One HTML page on several runs beside each other."""

from collections.abc import Sequence

from slamcli.evaluation.run_comparison import ComparedRun
from slamcli.report.template import fill


def render(table: Sequence[Sequence[str]], compared: Sequence[ComparedRun]) -> str:
    """Fill the page with the table of `run_comparison.rows` and what speaks against each map."""
    return fill("comparison.html", names=[one.name for one in compared], heading=table[0], rows=table[1:], compared=compared)
