"""HTML pages: templates, and JSON and scripts inside a page."""

import json
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup


def template(name: str) -> Template:
    """Load a page template of this package: every value is escaped, and a missing value is an error."""
    environment = Environment(
        loader=PackageLoader("polarnet.reports", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template(name)


def embedded_json(content: Any) -> Markup:
    """JSON for a script element; `<` is escaped, so that no text can end the element."""
    return Markup(json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"))


def script(name: str) -> Markup:
    """A JavaScript file of this package."""
    return Markup((files("polarnet.reports") / name).read_text(encoding="utf-8"))
