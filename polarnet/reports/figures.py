"""The style of all figures, light for files or in the colours of a page, and pictures in rows and columns.

Figures are returned, not shown; `polarnet.reports.maps.png` and `svg` encode them.
"""

import io
import re
from collections.abc import Sequence
from contextlib import ContextDecorator
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from polarnet.reports.maps import DOLP_COLOURS


@dataclass(frozen=True)
class Theme:
    """Colours of text and lines; charts have no background."""

    text: str
    quiet: str
    grid: str
    face: str
    """Colour behind pictures; "none" is transparent."""


LIGHT = Theme(text="#1c2330", quiet="#667085", grid="#e4e7ec", face="#ffffff")
PAGE = Theme(text="#00000a", quiet="#00000b", grid="#00000c", face="none")
"""Stands for the colours of the page, which `svg` puts in."""
VARIABLES = {PAGE.text: "var(--text)", PAGE.quiet: "var(--quiet)", PAGE.grid: "var(--line)"}
"""Variable of style.css.jinja for each colour of `PAGE`."""
UNUSED_IDS = re.compile(r' id="[A-Za-z0-9]+(?:\.[a-z]+)?_\d+"')  # nothing refers to the names of groups


def styled(theme: Theme) -> ContextDecorator:
    """The style of all figures in the colours of `theme`: a decorator of a function that draws."""
    settings: dict[Any, Any] = {
        "font.family": "DejaVu Sans",  # comes with matplotlib, so that text looks the same everywhere
        "font.size": 8,
        "text.color": theme.text,
        "axes.labelcolor": theme.quiet,
        "axes.titlecolor": theme.text,
        "axes.edgecolor": theme.grid,
        "axes.facecolor": "none",
        "axes.grid": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "grid.color": theme.grid,
        "grid.linewidth": 0.7,
        "xtick.color": theme.quiet,
        "ytick.color": theme.quiet,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "lines.linewidth": 1.5,
        "lines.markersize": 3,
        "legend.frameon": False,
        "legend.fontsize": 7,
    }
    return matplotlib.rc_context(settings)


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


def tile_grid(rows: int, columns: int, shape: Sequence[int], bar_row: int = 0) -> tuple[Figure, np.ndarray]:
    """A figure and its axes for pictures of `shape`, with a colour bar of DoLP beside row `bar_row`."""
    tile, label = 1.4, 0.15  # inches
    size = columns * tile + 0.7, rows * (tile * shape[0] / shape[1] + label) + 2 * label
    layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, wspace=0, hspace=0)
    figure = Figure(figsize=size, facecolor=LIGHT.face, layout=layout)
    grid = figure.subplots(rows, columns, squeeze=False)
    bar = grid[bar_row, -1].inset_axes((1.05, 0, 0.07, 1))
    colours = figure.colorbar(ScalarMappable(cmap=DOLP_COLOURS), cax=bar, ticks=[0, 0.5, 1])
    colours.ax.tick_params(labelsize=6, length=2, pad=2, colors=LIGHT.quiet)
    colours.outline.set_visible(False)
    return figure, grid


def show_picture(axes: Axes, picture: np.ndarray, theme: Theme) -> None:
    """Show a picture without ticks, in a thin frame."""
    axes.imshow(picture)
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=theme.grid, linewidth=0.6)
