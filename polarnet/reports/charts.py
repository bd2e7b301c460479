"""Charts of the pages in the pages' own colours (`polarnet.reports.figures.svg`), and the figure of a sweep."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from polarnet.methods.intensities import GAIN
from polarnet.reports.figures import LIGHT, PAGE, styled
from polarnet.reports.legend import OTHER_COLOUR, Legend, in_order
from polarnet.reports.tables import COLUMNS

WIDTH, HEIGHT = 4.8, 2.8  # inches
ROW_HEIGHT, LABEL_LETTERS = 0.26, 28  # of a label beside a chart: inches, and letters in a line of its label


def _axes(height: float = HEIGHT) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained", facecolor="none")
    return figure, figure.subplots()


def _dots(
    labels: Sequence[str],
    means: Sequence[float],
    intervals: Sequence[Sequence[float]],
    colours: Sequence[str],
    quantity: str,
    hollow: Sequence[bool] = (),
) -> Figure:
    """A row for each label, the first at the top: a dot at its mean, filled or hollow, and a line over its interval."""
    figure, axes = _axes(0.5 + ROW_HEIGHT * len(labels))
    rows = zip(means, intervals, colours, hollow or [False] * len(labels), strict=True)
    for place, (mean, interval, colour, empty) in enumerate(rows):
        axes.plot(interval, [place, place], color=colour)
        axes.plot(mean, place, "o", color=colour, markersize=5, fillstyle="none" if empty else "full")
    axes.set_yticks(range(len(labels)), [textwrap.fill(label, LABEL_LETTERS) for label in labels])
    axes.tick_params(axis="y", length=0)
    axes.set(ylim=(len(labels) - 0.5, -0.5), xlabel=quantity)
    axes.spines["left"].set_visible(False)
    return figure


@styled(PAGE)
def error_chart(metrics: Mapping[str, Mapping[str, Any]], legend: Legend) -> Figure:
    """MSE of each method with its 95 % interval."""
    methods = in_order(metrics)
    means, intervals = ([metrics[method][key] for method in methods] for key in ("mse", "mse_ci"))
    labels, colours = ([name(method) for method in methods] for name in (legend.label, legend.colour))
    solved = [method.endswith(GAIN) for method in methods]
    return _dots(labels, means, intervals, colours, COLUMNS["mse"].heading, solved)


@styled(LIGHT)
def sweep_chart(points: Mapping[str, tuple[float, float]]) -> Figure:
    """Validation MSE of the points of a sweep by their overrides: mean and standard deviation over seeds."""
    means = [mean for mean, _ in points.values()]
    intervals = [(mean - deviation, mean + deviation) for mean, deviation in points.values()]
    figure = _dots([*points], means, intervals, [OTHER_COLOUR] * len(points), "validation MSE")
    figure.set_facecolor(LIGHT.face)
    return figure


def _plain_numbers(*logarithmic: Axis) -> None:
    """Label 1, 2 and 5 of each decade of logarithmic axes."""
    for axis in logarithmic:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_locator(NullLocator())


@styled(PAGE)
def reliability_chart(curves: Mapping[str, Sequence[Sequence[float | int]]], legend: Legend) -> Figure:
    """Measured against expected squared error by method; dots grow with the number of pixels."""
    figure, axes = _axes()
    errors = [error for curve in curves.values() for point in curve for error in point[:2]]
    ends = max(0.8 * min(errors), 1e-6), 1.25 * max(errors)
    axes.plot(ends, ends, "--", color=PAGE.quiet, linewidth=1)
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
    _plain_numbers(axes.xaxis, axes.yaxis)
    for method, curve in curves.items():
        expected, measured, pixels = np.array(curve).T
        axes.plot(expected, measured, color=legend.colour(method), label=legend.label(method))
        axes.scatter(expected, measured, 4 + 40 * pixels / pixels.max(), color=legend.colour(method))
    axes.set(xlabel="expected squared error", ylabel="measured squared error")
    figure.legend(loc="outside upper left", ncols=2)
    return figure
