"""HTML pages: templates, JSON inside a page, and figures for light and dark themes."""

import json
from collections.abc import Callable
from importlib.resources import files
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from matplotlib.figure import Figure

from polarnet.reports.figures import DARK, LIGHT, Theme
from polarnet.reports.maps import data_uri, png


class Chart(NamedTuple):
    """A figure in two versions, for a light and a dark page."""

    light: str
    dark: str
    alt: str


def chart(draw: Callable[[Theme], Figure], alt: str) -> Chart:
    """Draw a figure for both themes, embedded in the page."""
    light, dark = (data_uri(png(draw(theme)), "png") for theme in (LIGHT, DARK))
    return Chart(light, dark, alt)


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
