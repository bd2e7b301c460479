"""HTML pages: templates, JSON and drawings inside a page."""

import io
import json
import re
from importlib.resources import files
from typing import Any

import matplotlib
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from polarnet.reports.figures import PAGE

VARIABLES = {PAGE.text: "var(--text)", PAGE.quiet: "var(--quiet)", PAGE.grid: "var(--line)"}
"""Variable of style.css.jinja for each colour of `PAGE`."""
UNUSED_IDS = re.compile(r' id="[A-Za-z0-9]+(?:\.[a-z]+)?_\d+"')  # nothing refers to the names of groups


def svg(figure: Figure) -> Markup:
    """A figure in the style of `PAGE` as a drawing inside the page, whose text and lines follow light and dark."""
    buffer = io.StringIO()
    FigureCanvasSVG(figure)
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "polarnet"}):  # the same bytes each time
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    drawing = UNUSED_IDS.sub("", buffer.getvalue()[buffer.getvalue().index("<svg") :])
    for colour, variable in VARIABLES.items():
        drawing = drawing.replace(colour, variable)
    return Markup(drawing)


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
