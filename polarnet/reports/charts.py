"""Charts of the pages in the pages' own colours (`polarnet.reports.figures.svg`), and figures of studies and sweeps."""

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
from polarnet.reports.legend import GENERAL, OTHER_COLOUR, Legend, in_order
from polarnet.reports.tables import COLUMNS

WIDTH, HEIGHT = 4.8, 2.8  # inches
ROW_HEIGHT, LABEL_LETTERS = 0.26, 28  # of a label beside a chart: inches, and letters in a line of its label
PAPER_EVENTS_PER_PIXEL = 1.04  # events per pixel at which the paper's recovery is good (section 5)


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


@styled(LIGHT)
def event_budget_figure(results: Mapping[str, Any]) -> Figure:
    """PSNR (dB) and correlation of DoLP against events per pixel since the start, and against window length.

    `results` is the content of event_budget.json.
    """
    figure = Figure(figsize=(7.0, 5.0), layout="constrained", facecolor="none")
    axes = figure.subplots(2, 2, sharey="row")
    for column, (study, x, scale, label, title) in zip(axes.T, (
        ("since_start", "events_per_pixel", 1.0, "events per pixel", "since the start (dashed: the paper's 1.04)"),
        ("window_length", "window_us", 1e-3, "window, ms", "by window length"),
    ), strict=True):  # fmt: skip
        for axis, metric in zip(column, ("psnr", "corr"), strict=True):
            for method in in_order(results[study]):
                places, values = zip(*((scale * one[x], one[metric]) for one in results[study][method]), strict=True)
                style = "o--" if method.endswith(GAIN) else "o-"
                axis.plot(places, values, style, color=GENERAL.colour(method), label=GENERAL.label(method))
            axis.set_xscale("log")
            _plain_numbers(axis.xaxis)
        column[0].set_title(title, loc="left", fontsize=9)
        column[1].set_xlabel(label)
    for axis, label in zip(axes[:, 0], ("PSNR, dB", "correlation"), strict=True):
        axis.axvline(PAPER_EVENTS_PER_PIXEL, color=LIGHT.quiet, linewidth=0.9, linestyle="--")
        axis.set_ylabel(label)
    axes[0][0].legend()
    return figure
