"""The style of all figures, light for files or in the colours of a page, and methods beside the truth on some scenes.

Figures are returned, not shown; `polarnet.reports.maps.png` and `svg` encode them.
"""

import io
import re
import textwrap
from collections.abc import Sequence
from contextlib import ContextDecorator
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from torch import Tensor

from polarnet.metrics.similarity import mse, psnr
from polarnet.reports.legend import GENERAL, Legend, with_structure
from polarnet.reports.maps import DOLP_COLOURS, dolp_image, event_full_scale, event_image
from polarnet.storage.panels import Panel


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
HEADING_LETTERS, NAME_LETTERS = 19, 18  # in a line above and beside a picture of a comparison
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


@styled(LIGHT)
def comparison_figure(panels: Sequence[Panel], legend: Legend = GENERAL) -> Figure:
    """Draw panels like the paper's Fig. 9 and 10: a row each, with events, truth and the DoLP of its methods.

    MSE and PSNR stand below each method; methods of one constant value are left out.
    """
    methods = with_structure(panels[0].predictions)
    headings = ["events, 0°", "true DoLP", *(textwrap.fill(legend.label(one), HEADING_LETTERS) for one in methods)]
    figure, grid = tile_grid(len(panels), len(headings), panels[0].s0.shape)
    for panel, row in zip(panels, grid, strict=True):
        tiles = [(event_image(panel.events[0], event_full_scale(panel.events)), ""), (dolp_image(panel.truth.dolp), "")]
        shown = [panel.predictions[method].dolp for method in methods]
        tiles += [(dolp_image(dolp), score_line(dolp, panel.truth.dolp)) for dolp in shown]
        for axes, (picture, below) in zip(row, tiles, strict=True):
            show_picture(axes, picture, LIGHT)
            axes.set_xlabel(below, fontsize=6, labelpad=2.5)
        name = panel.sequence
        row[0].set_ylabel(name if len(name) <= NAME_LETTERS else name[: NAME_LETTERS - 1] + "…", fontsize=6)
    for axes, heading in zip(grid[0], headings, strict=True):
        axes.set_title(heading, fontsize=8, pad=4)
    return figure


def score_line(recovered: Float[Tensor, "h w"], truth: Float[Tensor, "h w"]) -> str:
    """MSE and PSNR of one frame, as the text below its picture."""
    error, ratio = (float(score(recovered[None], truth[None])) for score in (mse, psnr))
    return f"{error:.4f} · {ratio:.2f} dB"
