"""Charts of the pages, drawn in the page's own colours (`polarnet.reports.html.svg`)."""

import functools
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from polarnet.reports.artefacts import BudgetPoint, History, Results
from polarnet.reports.figures import PAGE, chart_style
from polarnet.reports.legend import Legend, in_order, with_structure
from polarnet.reports.tables import Column

TERMS = {
    "total": "total (weighted)",
    "mse": "MSE",
    "mae": "MAE",
    "ssim_loss": "1 - SSIM",
    "lpips": "LPIPS",
    "stokes": "S1/S0, S2/S0",
    "relative_mse": "MSE (relative)",
    "relative_stokes": "S1/S0, S2/S0 (relative)",
}
"""Legend labels of loss terms."""
BRANCHES = {"intensity": "intensity", "aolp": "AoLP", "dolp": "DoLP"}
"""Outputs of a network with one loss per output; their terms are named BRANCH_TERM."""
WIDTH, HEIGHT = 4.8, 2.8  # inches
ROW_HEIGHT, LABEL_LETTERS = 0.26, 28  # of a method beside a chart: inches, and letters in a line of its label

Arguments = ParamSpec("Arguments")


def _charted(draw: Callable[Arguments, Figure]) -> Callable[Arguments, Figure]:
    """Draw in the style of the pages."""

    @functools.wraps(draw)
    def drawn(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Figure:
        with matplotlib.rc_context(chart_style(PAGE)):
            return draw(*args, **kwargs)

    return drawn


def _axes(height: float = HEIGHT, width: float = WIDTH) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="none")
    return figure, figure.subplots()


def _method_axes(labels: Sequence[str]) -> tuple[Figure, Axes]:
    """Axes with a row for each label, the first at the top."""
    figure, axes = _axes(0.5 + ROW_HEIGHT * len(labels))
    axes.set_yticks(range(len(labels)), [textwrap.fill(label, LABEL_LETTERS) for label in labels])
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.spines["left"].set_visible(False)
    return figure, axes


def _above(figure: Figure) -> None:
    """Put the legend above the axes."""
    figure.legend(loc="outside upper left", ncols=2, frameon=False, fontsize=7)


def _logarithmic(axes: Axes, which: str) -> None:
    """Make `which` of the axes x and y logarithmic, with plain numbers at 1, 2 and 5 of each decade."""
    for name in which:
        axes.set(**{f"{name}scale": "log"})
        axis = axes.xaxis if name == "x" else axes.yaxis
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_locator(NullLocator())


def _diagonal(axes: Axes, values: Iterable[float]) -> None:
    """Logarithmic axes with equal ends, and the line on which both are equal."""
    given = list(values)
    ends = max(0.8 * min(given), 1e-6), 1.25 * max(given)
    axes.plot(ends, ends, "--", color=PAGE.quiet, linewidth=1)
    _logarithmic(axes, "xy")
    axes.set(xlim=ends, ylim=ends)


@_charted
def score_chart(metrics: Mapping[str, Mapping[str, Any]], key: str, column: Column, legend: Legend) -> Figure:
    """A score of each method that has it, with its 95 % interval."""
    methods = [method for method in in_order(metrics) if metrics[method].get(key) is not None]
    figure, axes = _method_axes([legend.label(method) for method in methods])
    for place, method in enumerate(methods):
        axes.plot(metrics[method].get(f"{key}_ci", []) or [], [place] * len(metrics[method].get(f"{key}_ci") or []),
                  color=legend.colour(method))  # fmt: skip
        axes.plot(metrics[method][key], place, "o", color=legend.colour(method), markersize=5)
    axes.set_xlabel(column.heading)
    return figure


@_charted
def scatter_chart(means: Mapping[str, Mapping[str, float]], rival: str, legend: Legend) -> Figure:
    """MSE of ours against that of another method, a dot a scene; below the line ours is better.

    `means` is method, then scene.
    """
    scenes = [scene for scene in means["ours"] if scene in means[rival]]
    figure, axes = _axes()
    _diagonal(axes, [means[method][scene] for method in ("ours", rival) for scene in scenes])
    x, y = ([means[method][scene] for scene in scenes] for method in (rival, "ours"))
    axes.plot(x, y, "o", color=legend.colour("ours"), markersize=5)
    axes.set(xlabel=f"MSE of {legend.label(rival)}", ylabel="MSE of ours")
    return figure


@_charted
def spread_chart(means: Mapping[str, Mapping[str, float]], legend: Legend) -> Figure:
    """MSE of every scene and method; the stroke is the median."""
    methods = in_order(means)
    figure, axes = _method_axes([legend.label(method) for method in methods])
    for place, method in enumerate(methods):
        values = [mse for mse in means[method].values() if mse > 0]
        axes.plot(values, [place] * len(values), "o", color=legend.colour(method), markersize=4, alpha=0.6)
        axes.plot([np.median(values)] if values else [], [place] if values else [], "|", color=PAGE.text, markersize=12)
    _logarithmic(axes, "x")
    axes.set_xlabel("MSE of a scene")
    return figure


@_charted
def loss_chart(history: History) -> Figure:
    """Loss terms over epochs from 1, logarithmic if all are positive."""
    figure, axes = _axes()
    for term, values in history.loss.items():
        axes.plot(range(1, len(values) + 1), values, "o-", markersize=3, label=term_label(term))
    if all(value > 0 for values in history.loss.values() for value in values):
        _logarithmic(axes, "y")
    axes.set(xlabel="epoch", ylabel="training loss")
    _above(figure)
    return figure


@_charted
def psnr_chart(history: History, output: str) -> Figure:
    """Validation PSNR over epochs from 1."""
    figure, axes = _axes()
    psnr = history.validation["psnr"]
    axes.plot(range(1, len(psnr) + 1), psnr, "o-", markersize=3)
    axes.set(xlabel="epoch", ylabel=f"validation PSNR of {output}, dB")
    return figure


def term_label(name: str) -> str:
    """Legend label of a loss term."""
    branch, _, term = name.partition("_")
    return f"{BRANCHES[branch]}: {TERMS[term]}" if branch in BRANCHES and term in TERMS else TERMS.get(name, name)


@_charted
def reliability_chart(curves: Mapping[str, Sequence[Sequence[float | int]]], legend: Legend) -> Figure:
    """Measured against expected squared error by method; dots grow with the number of pixels."""
    figure, axes = _axes()
    _diagonal(axes, [end for curve in curves.values() for point in curve for end in point[:2]])
    for method, curve in curves.items():
        expected, measured, pixels = np.array(curve).T
        axes.plot(expected, measured, color=legend.colour(method), label=legend.label(method))
        axes.scatter(expected, measured, 4 + 40 * pixels / pixels.max(), color=legend.colour(method))
    axes.set(xlabel="expected squared error", ylabel="measured squared error")
    _above(figure)
    return figure


@_charted
def budget_chart(points: Sequence[BudgetPoint], legend: Legend) -> Figure:
    """Mean MSE against the events per pixel since the start of a sequence, a line a method."""
    figure, axes = _axes(HEIGHT + 0.5)
    for method in in_order(dict.fromkeys(point.method for point in points)):
        own = [point for point in points if point.method == method and point.events_per_pixel > 0]
        axes.plot([point.events_per_pixel for point in own], [point.mse for point in own], "o-", markersize=3,
                  color=legend.colour(method), label=legend.label(method))  # fmt: skip
    _logarithmic(axes, "x")
    axes.set(xlabel="events per pixel since the start", ylabel="MSE")
    _above(figure)
    return figure


@_charted
def sets_chart(sets: Sequence[Results], titles: Mapping[str, str], legend: Legend) -> Figure:
    """Heat map: MSE of each method on each test set, divided by the best constant's; no tile without both."""
    methods = with_structure(dict.fromkeys(method for one in sets for method in one.metrics))
    ratios = np.array([[_to_constant(one, method) for one in sets] for method in methods])
    figure, axes = _method_axes([legend.label(method) for method in methods])
    logarithms = np.log(ratios)
    axes.imshow(logarithms, cmap="cividis_r", aspect="auto")
    axes.set_xticks(range(len(sets)), [textwrap.fill(titles.get(one.name, one.name), 14) for one in sets])
    axes.xaxis.tick_top()
    axes.grid(visible=False)
    middle = (np.nanmin(logarithms) + np.nanmax(logarithms)) / 2
    for (row, column), ratio in np.ndenumerate(ratios):
        if np.isfinite(ratio):
            ink = "#ffffff" if logarithms[row, column] > middle else "#10141b"
            axes.text(column, row, f"{ratio:.2f}", ha="center", va="center", color=ink)
    return figure


def _to_constant(one: Results, method: str) -> float:
    """MSE of a method on a set, divided by that of the best constant; not a number where either is unknown."""
    mse, constant = (one.metrics.get(row, {}).get("mse") for row in (method, "oracle_mean"))
    return mse / constant if mse and constant else float("nan")
