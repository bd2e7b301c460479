"""Figures drawn with matplotlib: comparison panels, training curves, distributions of scores over scenes.

Figures are returned, not shown; `polarnet.reports.maps.png` encodes them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter
from torch import Tensor

from polarnet.metrics.similarity import mse, psnr
from polarnet.reports.legend import GENERAL, Legend, in_order, with_structure
from polarnet.reports.maps import DOLP_COLOURS, dolp_image, event_full_scale, event_image, png
from polarnet.reports.tables import COLUMNS


@dataclass(frozen=True)
class Theme:
    """Colours of text and lines on a light or a dark page; the figure itself has no background."""

    text: str
    quiet: str
    grid: str
    face: str
    """Colour of the page, for markers that must hide lines behind them; "none" is transparent."""


LIGHT = Theme(text="#1c2330", quiet="#667085", grid="#e4e7ec", face="#ffffff")
DARK = Theme(text="#e6e9ef", quiet="#98a2b3", grid="#313947", face="#161b24")

TERMS = {
    "mse": "MSE",
    "mae": "MAE",
    "ssim_loss": "1 - SSIM",
    "lpips": "LPIPS",
    "stokes": "S1/S0, S2/S0",
    "uncertainty": "likelihood of the error",
}
"""Legend labels of loss terms."""

BRANCHES = {"intensity": "intensity", "aolp": "AoLP", "dolp": "DoLP"}
"""Outputs of a network with one loss per output; their terms are named BRANCH_TERM."""


class PanelScene(NamedTuple):
    """One row of a comparison: a window of one test scene, its truth and each method's prediction."""

    name: str
    events: Float[Tensor, "4 h w"]
    truth: Float[Tensor, "h w"]
    recovered: Mapping[str, Float[Tensor, "h w"]]


class Curve(NamedTuple):
    """One line of a training figure; `values` holds NaN for epochs without a value."""

    label: str
    epochs: Sequence[int]
    values: Sequence[float]


class ReliabilityLine(NamedTuple):
    """One line of a reliability plot; `curve` holds predicted error, measured error and pixels of each bin."""

    label: str
    colour: str
    curve: Sequence[tuple[float, float, int]]


def comparison_panel(rows: Sequence[PanelScene], path: Path, legend: Legend = GENERAL, theme: Theme = LIGHT) -> None:
    """Write a picture like the paper's Fig. 10, with a row per scene.

    A row shows events, truth and each method, with MSE and PSNR below. Methods that predict one value everywhere are
    left out.
    """
    if not rows:
        raise ValueError("a comparison panel needs at least one scene, got none")
    methods = with_structure(rows[0].recovered)
    height, width = rows[0].truth.shape
    grid = _TileGrid(len(rows), 2 + len(methods), tile_width=1.35, aspect=height / width)
    figure = _figure(grid.size, theme)
    figure.patch.set_facecolor(theme.face)
    for i, row in enumerate(rows):
        full_scale = event_full_scale(row.events)
        tiles = [(event_image(row.events[0], full_scale), ""), (dolp_image(row.truth), "")]
        tiles += [(dolp_image(row.recovered[m]), score_line(row.recovered[m], row.truth)) for m in methods]
        headings = ["events, 0°", "true DoLP", *map(legend.label, methods)]
        for j, ((picture, below), heading) in enumerate(zip(tiles, headings, strict=True)):
            axes = figure.add_axes(grid.rectangle(i, j))
            show_picture(axes, picture, theme)
            axes.set_xlabel(below, color=theme.quiet, fontsize=6, labelpad=2.5)
            if i == 0:
                axes.set_title(heading, color=theme.text, fontsize=8, pad=4)
            if j == 0:
                axes.set_ylabel(_short(row.name), color=theme.quiet, fontsize=6)
    bar_axes = figure.add_axes(grid.beside())
    _colour_bar(figure, bar_axes, theme, "vertical", label_size=6.0)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png(figure))


def training_curves(loss: Sequence[Curve], validation: Sequence[Curve], validation_label: str, theme: Theme) -> Figure:
    """Loss terms of training on the left (logarithmic), a validation score on the right, over epochs from 1."""
    with matplotlib.rc_context(chart_style(theme)):
        figure = Figure(figsize=(5.7, 2.5), layout="constrained", facecolor="none")
        left, right = figure.subplots(1, 2)
        for axes, curves, label in ((left, loss, "training loss"), (right, validation, validation_label)):
            for curve in curves:
                axes.plot(
                    [e + 1 for e in curve.epochs],
                    curve.values,
                    marker="o",
                    markersize=3,
                    label=_term(curve.label),
                )
            axes.set_xlabel("epoch")
            axes.set_title(label, loc="left", fontsize=9)
            axes.xaxis.get_major_locator().set_params(integer=True)
            if len(curves) > 1:
                axes.legend(frameon=False, fontsize=7, labelcolor=theme.text)
        if all(value > 0 for curve in loss for value in curve.values):
            left.set_yscale("log")
            _plain_log_ticks(left.yaxis)
    return figure


def _term(name: str) -> str:
    branch, _, term = name.partition("_")
    return f"{BRANCHES[branch]}: {TERMS[term]}" if branch in BRANCHES and term in TERMS else TERMS.get(name, name)


def score_distribution(
    per_scene: Mapping[str, Mapping[str, Sequence[float]]], theme: Theme, legend: Legend = GENERAL
) -> Figure:
    """One plot per metric, with a box per method and a dot per test scene.

    `per_scene` is metric, then method, then the scenes' means. Boxes span the quartiles, whiskers all scenes.
    """
    metrics = [key for key in COLUMNS if key in per_scene]
    methods = in_order(dict.fromkeys(method for key in metrics for method in per_scene[key]))
    with matplotlib.rc_context(chart_style(theme)):
        figure = Figure(figsize=(9.4, 0.62 + 0.27 * len(methods)), layout="constrained", facecolor="none")
        for axes, metric in zip(np.atleast_1d(figure.subplots(1, len(metrics), sharey=True)), metrics, strict=True):
            for position, method in enumerate(methods):
                _strip(axes, position, per_scene[metric].get(method, ()), legend.colour(method), theme)
            axes.set_title(COLUMNS[metric].heading, loc="left", fontsize=9)
            if metric == "mse":
                axes.set_xscale("log")  # errors of good and bad methods differ by an order of magnitude
                _plain_log_ticks(axes.xaxis)
            axes.set_yticks(range(len(methods)), [*map(legend.label, methods)])
            axes.set_ylim(len(methods) - 0.4, -0.6)
            axes.grid(axis="y", visible=False)
            axes.tick_params(axis="y", length=0)
    return figure


def reliability_figure(
    curves: Mapping[str, Sequence[tuple[float, float, int]]], theme: Theme, legend: Legend = GENERAL
) -> Figure:
    """Measured against predicted squared error of DoLP, a line per method; calibrated errors lie on the diagonal.

    `curves` are those of `polarnet.metrics.reliability`: predicted, measured, pixels. Dots grow with the pixels.
    """
    figure = _figure((3.4, 3.2), theme)
    with matplotlib.rc_context(chart_style(theme)):
        lines = [
            ReliabilityLine(legend.label(method), legend.colour(method), curve) for method, curve in curves.items()
        ]
        draw_reliability(figure.add_subplot(), lines, theme)
    figure.tight_layout()
    return figure


def draw_reliability(axes: Axes, lines: Sequence[ReliabilityLine], theme: Theme) -> None:
    """Draw measured against predicted squared error, and the diagonal; dots grow with the number of pixels."""
    ends = [value for line in lines for predicted, measured, _ in line.curve for value in (predicted, measured)]
    diagonal = [min(value for value in ends if value > 0), max(ends)]
    axes.plot(diagonal, diagonal, color=theme.quiet, linewidth=0.8)
    for label, colour, curve in lines:
        predicted, measured, pixels = (np.array(column) for column in zip(*curve, strict=True))
        axes.plot(predicted, measured, color=colour, label=label)
        axes.scatter(predicted, measured, s=4 + 60 * pixels / pixels.sum(), color=colour, linewidths=0, zorder=3)
    axes.set(xscale="log", yscale="log", xlabel="predicted squared error", ylabel="measured squared error")
    _plain_log_ticks(axes.xaxis)
    _plain_log_ticks(axes.yaxis)
    axes.legend(frameon=False)


def score_line(recovered: Float[Tensor, "h w"], truth: Float[Tensor, "h w"]) -> str:
    """MSE and PSNR of one frame, as the text below its picture."""
    error, ratio = (float(score(recovered[None], truth[None])) for score in (mse, psnr))
    return f"{error:.4f} · {ratio:.2f} dB"


def dolp_bar(theme: Theme) -> Figure:
    """Colour bar of `maps.dolp_image`."""
    figure = _figure((2.1, 0.32), theme)
    axes = figure.add_axes((0.06, 0.6, 0.88, 0.38))
    _colour_bar(figure, axes, theme, "horizontal", label_size=8.0)
    return figure


@dataclass(frozen=True)
class _TileGrid:
    """Layout of a panel's pictures in inches; every tile keeps its aspect ratio."""

    rows: int
    columns: int
    tile_width: float
    aspect: float
    gap: float = 0.06
    left: float = 0.22
    right: float = 0.5
    top: float = 0.26
    below: float = 0.2

    @property
    def tile_height(self) -> float:
        return self.tile_width * self.aspect

    @property
    def size(self) -> tuple[float, float]:
        width = self.left + self.columns * (self.tile_width + self.gap) + self.right
        return width, self.top + self.rows * (self.tile_height + self.below)

    def rectangle(self, row: int, column: int) -> tuple[float, float, float, float]:
        width, height = self.size
        x = self.left + column * (self.tile_width + self.gap)
        y = height - self.top - row * (self.tile_height + self.below) - self.tile_height
        return x / width, y / height, self.tile_width / width, self.tile_height / height

    def beside(self) -> tuple[float, float, float, float]:
        x, y, _, height = self.rectangle(0, self.columns)
        return x + 0.04 / self.size[0], y, 0.09 / self.size[0], height


def _figure(size: tuple[float, float], theme: Theme) -> Figure:
    with matplotlib.rc_context(chart_style(theme)):
        return Figure(figsize=size, facecolor="none")


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


def _colour_bar(figure: Figure, axes: Axes, theme: Theme, orientation: str, label_size: float) -> None:
    bar = figure.colorbar(ScalarMappable(cmap=DOLP_COLOURS), cax=axes, orientation=orientation, ticks=[0, 0.5, 1])
    bar.ax.tick_params(labelsize=label_size, length=2, pad=2, colors=theme.quiet)
    bar.outline.set_visible(False)


def _plain_log_ticks(axis: Axis) -> None:
    """Label 1, 2 and 5 of each decade in plain notation: 0.05, not 5 x 10^-2."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_locator(NullLocator())


def _strip(axes: Axes, position: int, values: Sequence[float], colour: str, theme: Theme) -> None:
    known = np.array([value for value in values if np.isfinite(value)])
    if len(known) == 0:
        return
    axes.boxplot(
        known, positions=[position], orientation="horizontal", widths=0.62, whis=(0, 100), patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": colour, "alpha": 0.28, "linewidth": 0}, medianprops={"color": theme.text},
        whiskerprops={"color": colour, "linewidth": 0.8}, capprops={"linewidth": 0},
    )  # fmt: skip
    offset = (np.arange(len(known)) % 5 - 2) * 0.08  # spreads overlapping dots without randomness
    axes.scatter(known, position + offset, s=6, color=colour, alpha=0.8, linewidths=0, zorder=3)


def _short(name: str) -> str:
    return name if len(name) <= 18 else name[:17] + "…"
