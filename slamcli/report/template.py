"""Templates of pages, filled by jinja2: every text that is not marked as safe is escaped, and a name that is missing is an error."""

from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup


def fill(template: str, **values: Any) -> str:
    """Fill a template of this package; `style` and, where there is one of the name, `script` come from beside it."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(resource), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template).render(style=Markup(resource("page.css")), **values).lstrip() + "\n"


def thousands(n: int) -> str:
    """Write a number with narrow spaces between its thousands."""
    return f"{n:,}".replace(",", "\u202f")


def resource(name: str) -> str:
    """Read a file of this package."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
