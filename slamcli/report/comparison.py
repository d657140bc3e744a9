"""One HTML page on several runs beside each other."""

import html
from collections.abc import Sequence

from slamcli.evaluation.run_comparison import Compared
from slamcli.report.page import resource

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<title>slamcli compare</title>
<style>
{style}
</style>
</head>
<body>
<header><h1>Runs compared</h1><p>{names}</p></header>
<main>
<section><div class="scroll"><table>{head}<tbody>{body}</tbody></table></div></section>
{remarks}
</main>
</body>
</html>
"""


def render(table: Sequence[Sequence[str]], compared: Sequence[Compared]) -> str:
    """Fill the page with the table of `run_comparison.rows` and what speaks against each map."""
    return PAGE.format(
        style=resource("page.css"),
        names=html.escape(", ".join(one.name for one in compared)),
        head=f"<thead>{_row('th', table[0])}</thead>",
        body="".join(_row("td", row) for row in table[1:]),
        remarks="".join(_remarks(one) for one in compared),
    )


def _row(tag: str, cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def _remarks(one: Compared) -> str:
    findings = one.verdict.findings if one.verdict is not None else ()
    items = "".join(f'<li class="note">{html.escape(str(finding))}</li>' for finding in findings)
    return f'<section><h2>{html.escape(one.name)}</h2><ul class="remarks">{items}</ul></section>' if items else ""
