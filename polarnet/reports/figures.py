"""Figures and charts in one style, in files and inside a page: methods beside the truth, errors, points of a sweep.

Figures are returned, not shown; `polarnet.reports.maps.png` and `svg` encode them.
"""

import io
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter
from torch import Tensor

from polarnet.methods.intensities import GAIN
from polarnet.metrics.similarity import mse, psnr
from polarnet.reports.legend import GENERAL, OTHER_COLOUR, Legend, in_order, with_structure
from polarnet.reports.maps import DOLP_COLOURS, dolp_image, event_full_scale, event_image
from polarnet.reports.tables import COLUMNS
from polarnet.storage.panels import Panel

TEXT, GREY, GRID, FACE = "#1c2330", "#667085", "#e4e7ec", "#ffffff"
"""Colours of text, of quieter text, of lines, and behind pictures."""
PAGE = {TEXT: "var(--text)", GREY: "var(--quiet)", GRID: "var(--line)"}
"""Variable of style.css.jinja for each colour, which `svg` puts in."""
HEADING_LETTERS, NAME_LETTERS = 19, 18  # in a line above and beside a picture of a comparison
WIDTH, HEIGHT = 4.8, 2.8  # inches
ROW_HEIGHT, LABEL_LETTERS = 0.26, 28  # of a label beside a chart: inches, and letters in a line of its label
UNUSED_IDS = re.compile(r' id="[A-Za-z0-9]+(?:\.[a-z]+)?_\d+"')  # nothing refers to the names of groups
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so that text looks the same everywhere
    "font.size": 8,
    "text.color": TEXT,
    "axes.labelcolor": GREY,
    "axes.titlecolor": TEXT,
    "axes.edgecolor": GRID,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "lines.linewidth": 1.5,
    "lines.markersize": 3,
    "legend.frameon": False,
    "legend.fontsize": 7,
}
styled = matplotlib.rc_context(STYLE)  # the style of all figures: a decorator of a function that draws


def svg(figure: Figure) -> Markup:
    """A figure as a drawing inside the page, whose text and lines follow light and dark."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "polarnet"}):  # the same bytes each time
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    drawing = UNUSED_IDS.sub("", buffer.getvalue()[buffer.getvalue().index("<svg") :])
    for colour, variable in PAGE.items():
        drawing = drawing.replace(colour, variable)
    return Markup(drawing)


def tile_grid(rows: int, columns: int, shape: Sequence[int], bar_row: int = 0) -> tuple[Figure, np.ndarray]:
    """A figure and its axes for pictures of `shape`, with a colour bar of DoLP beside row `bar_row`."""
    tile, label = 1.4, 0.15  # inches
    size = columns * tile + 0.7, rows * (tile * shape[0] / shape[1] + label) + 2 * label
    layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, wspace=0, hspace=0)
    figure = Figure(figsize=size, facecolor=FACE, layout=layout)
    grid = figure.subplots(rows, columns, squeeze=False)
    bar = grid[bar_row, -1].inset_axes((1.05, 0, 0.07, 1))
    colours = figure.colorbar(ScalarMappable(cmap=DOLP_COLOURS), cax=bar, ticks=[0, 0.5, 1])
    colours.ax.tick_params(labelsize=6, length=2, pad=2, colors=GREY)
    colours.outline.set_visible(False)
    return figure, grid


def show_picture(axes: Axes, picture: np.ndarray) -> None:
    """Show a picture without ticks, in a thin frame."""
    axes.imshow(picture)
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=GRID, linewidth=0.6)


@styled
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
            show_picture(axes, picture)
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


class Dot(NamedTuple):
    """A row of a chart."""

    label: str
    mean: float
    interval: Sequence[float]
    colour: str
    hollow: bool = False


def _axes(height: float = HEIGHT) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained", facecolor="none")
    return figure, figure.subplots()


def _dots(dots: Sequence[Dot], quantity: str) -> Figure:
    """A row for each dot, the first at the top, and a line over its interval."""
    figure, axes = _axes(0.5 + ROW_HEIGHT * len(dots))
    for place, dot in enumerate(dots):
        axes.plot(dot.interval, [place, place], color=dot.colour)
        axes.plot(dot.mean, place, "o", color=dot.colour, markersize=5, fillstyle="none" if dot.hollow else "full")
    axes.set_yticks(range(len(dots)), [textwrap.fill(dot.label, LABEL_LETTERS) for dot in dots])
    axes.tick_params(axis="y", length=0)
    axes.set(ylim=(len(dots) - 0.5, -0.5), xlabel=quantity)
    axes.spines["left"].set_visible(False)
    return figure


@styled
def error_chart(metrics: Mapping[str, Mapping[str, Any]], legend: Legend) -> Figure:
    """MSE of each method with its 95 % interval."""
    dots = [
        Dot(legend.label(row), metrics[row]["mse"], metrics[row]["mse_ci"], legend.colour(row), row.endswith(GAIN))
        for row in in_order(metrics)
    ]
    return _dots(dots, COLUMNS["mse"].heading)


@styled
def sweep_chart(points: Mapping[str, tuple[float, float]]) -> Figure:
    """Validation MSE of the points of a sweep by their overrides: mean and standard deviation over seeds."""
    dots = [Dot(point, mean, (mean - std, mean + std), OTHER_COLOUR) for point, (mean, std) in points.items()]
    figure = _dots(dots, "validation MSE")
    figure.set_facecolor(FACE)
    return figure


@styled
def reliability_chart(curves: Mapping[str, Sequence[Sequence[float | int]]], legend: Legend) -> Figure:
    """Measured against expected squared error by method; dots grow with the number of pixels."""
    figure, axes = _axes()
    errors = [error for curve in curves.values() for point in curve for error in point[:2]]
    ends = max(0.8 * min(errors), 1e-6), 1.25 * max(errors)
    axes.plot(ends, ends, "--", color=GREY, linewidth=1)
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_locator(NullLocator())
    for method, curve in curves.items():
        expected, measured, pixels = np.array(curve).T
        axes.plot(expected, measured, color=legend.colour(method), label=legend.label(method))
        axes.scatter(expected, measured, 4 + 40 * pixels / pixels.max(), color=legend.colour(method))
    axes.set(xlabel="expected squared error", ylabel="measured squared error")
    figure.legend(loc="outside upper left", ncols=2)
    return figure
