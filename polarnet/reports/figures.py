"""Figures drawn with matplotlib for use outside the page: comparison panels, the wheel of AoLP.

Figures are returned, not shown; `polarnet.reports.maps.png` encodes them.
"""

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from torch import Tensor

from polarnet.metrics.similarity import mse, psnr
from polarnet.reports.legend import GENERAL, Legend, with_structure
from polarnet.reports.maps import DOLP_COLOURS, dolp_image, event_full_scale, event_image, hue_wheel
from polarnet.storage.panels import Panel

HEADING_LETTERS = 19  # in a line above a picture


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
"""Stands for the colours of the page, which `polarnet.reports.html.svg` puts in."""


def comparison_figure(panels: Sequence[Panel], methods: Iterable[str], legend: Legend = GENERAL) -> Figure:
    """Draw panels like the paper's Fig. 9 and 10: a row each, with events, truth and the DoLP of `methods`.

    MSE and PSNR stand below each method; methods of one constant value are left out. ValueError without panels.
    """
    if not panels:
        raise ValueError("a comparison needs at least one panel, got none")
    methods = with_structure(methods)
    labels = ["events, 0°", "true DoLP", *map(legend.label, methods)]
    headings = [textwrap.fill(label, HEADING_LETTERS) for label in labels]
    lines = max(1 + heading.count("\n") for heading in headings)
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure, grid = tile_grid(len(panels), len(headings), panels[0].s0.shape, heading_lines=lines)
        for panel, row in zip(panels, grid, strict=True):
            full_scale = event_full_scale(panel.events)
            tiles = [(event_image(panel.events[0], full_scale), ""), (dolp_image(panel.truth.dolp), "")]
            shown = [panel.predictions[method].dolp for method in methods]
            tiles += [(dolp_image(dolp), score_line(dolp, panel.truth.dolp)) for dolp in shown]
            for axes, (picture, below) in zip(row, tiles, strict=True):
                show_picture(axes, picture, LIGHT)
                axes.set_xlabel(below, color=LIGHT.quiet, fontsize=6, labelpad=2.5)
            row[0].set_ylabel(_short(panel.sequence), color=LIGHT.quiet, fontsize=6)
        for axes, heading in zip(grid[0], headings, strict=True):
            axes.set_title(heading, color=LIGHT.text, fontsize=8, pad=4)
    return figure


def tile_grid(
    rows: int, columns: int, shape: Sequence[int], bar_row: int = 0, heading_lines: int = 1
) -> tuple[Figure, np.ndarray]:
    """A figure and its axes for pictures of `shape`, with a colour bar of DoLP beside row `bar_row`."""
    tile, gap, left, right, top, below = 1.35, 0.06, 0.22, 0.5, 0.12 + 0.14 * heading_lines, 0.2  # inches
    tile_height = tile * shape[0] / shape[1]
    width, height = left + columns * (tile + gap) + right, top + rows * (tile_height + below)
    figure = Figure(figsize=(width, height), facecolor=LIGHT.face)
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(
        left / width, below / height, 1 - (right + gap) / width, 1 - top / height, gap / tile, below / tile_height
    )
    place = grid[bar_row, -1].get_position()
    bar = figure.add_axes((place.x1 + (gap + 0.04) / width, place.y0, 0.09 / width, place.height))
    colours = figure.colorbar(ScalarMappable(cmap=DOLP_COLOURS), cax=bar, ticks=[0, 0.5, 1])
    colours.ax.tick_params(labelsize=6, length=2, pad=2, colors=LIGHT.quiet)
    colours.outline.set_visible(False)
    return figure, grid


def score_line(recovered: Float[Tensor, "h w"], truth: Float[Tensor, "h w"]) -> str:
    """MSE and PSNR of one frame, as the text below its picture."""
    error, ratio = (float(score(recovered[None], truth[None])) for score in (mse, psnr))
    return f"{error:.4f} · {ratio:.2f} dB"


def draw_wheel(axes: Axes, size: int, label_size: float) -> None:
    """Draw `hue_wheel`, `size` pixels wide, labelled with AoLP at 0, 45, 90 and 135 degrees."""
    axes.imshow(hue_wheel(size))
    axes.axis("off")
    for angle, (across, up, sideways, upright) in {
        "0°": (1.05, 0.5, "left", "center"), "45°": (0.87, 0.88, "left", "bottom"),
        "90°": (0.5, 1.03, "center", "bottom"), "135°": (0.13, 0.88, "right", "bottom"),
    }.items():  # fmt: skip
        place: dict[str, Any] = {"transform": axes.transAxes, "ha": sideways, "va": upright}
        axes.text(across, up, angle, color=LIGHT.quiet, fontsize=label_size, **place)


def chart_style(theme: Theme) -> dict[Any, Any]:
    """matplotlib settings shared by all figures."""
    return {
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
        "axes.prop_cycle": cycler(color=["#d6336c", "#3d8fd9", "#e08a1e", "#4aa37c", "#8b6fd6"]),
    }


def show_picture(axes: Axes, picture: np.ndarray, theme: Theme) -> None:
    """Show a picture without ticks, in a thin frame."""
    axes.imshow(picture)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set(visible=True, color=theme.grid, linewidth=0.6)


def _short(name: str) -> str:
    return name if len(name) <= 18 else name[:17] + "…"
