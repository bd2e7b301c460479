"""Charts of the pages in the pages' own colours (`polarnet.reports.figures.svg`), and the figure of a sweep."""

import contextlib
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from polarnet.reports.artefacts import History, Results
from polarnet.reports.figures import LIGHT, PAGE, styled
from polarnet.reports.legend import Legend, in_order, with_structure
from polarnet.reports.tables import Column

WIDTH, HEIGHT = 4.8, 2.8  # inches
ROW_HEIGHT, LABEL_LETTERS = 0.26, 28  # of a method beside a chart: inches, and letters in a line of its label


def _axes(height: float = HEIGHT) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained", facecolor="none")
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
    figure.legend(loc="outside upper left", ncols=2)


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


@styled(PAGE)
def score_chart(metrics: Mapping[str, Mapping[str, Any]], key: str, column: Column, legend: Legend) -> Figure:
    """A score of each method that has it, with its 95 % interval."""
    methods = [method for method in in_order(metrics) if metrics[method].get(key) is not None]
    figure, axes = _method_axes([legend.label(method) for method in methods])
    for place, method in enumerate(methods):
        interval = metrics[method].get(f"{key}_ci") or []
        axes.plot(interval, [place] * len(interval), color=legend.colour(method))
        axes.plot(metrics[method][key], place, "o", color=legend.colour(method), markersize=5)
    axes.set_xlabel(column.heading)
    return figure


@styled(PAGE)
def scatter_chart(means: Mapping[str, Mapping[str, float]], rival: str, legend: Legend) -> Figure:
    """MSE of ours against that of another method, a dot a scene; below the line ours is better.

    `means` is method, then scene.
    """
    scenes = [scene for scene in means["ours"] if scene in means[rival]]
    figure, axes = _axes()
    _diagonal(axes, [means[method][scene] for method in ("ours", rival) for scene in scenes])
    x, y = ([means[method][scene] for scene in scenes] for method in (rival, "ours"))
    axes.plot(x, y, "o", color=legend.colour("ours"), markersize=4)
    axes.set(xlabel=f"MSE of {legend.label(rival)}", ylabel="MSE of ours")
    return figure


@styled(PAGE)
def training_chart(history: History, output: str) -> Figure:
    """Loss terms, logarithmic if all are positive, and validation PSNR over epochs from 1."""
    figure = Figure(figsize=(WIDTH, 1.7 * HEIGHT), layout="constrained", facecolor="none")
    loss, psnr = figure.subplots(2, sharex=True, height_ratios=(3, 2))
    for term, values in history.loss.items():
        loss.plot(range(1, len(values) + 1), values, "o-", label=term.replace("_", " "))
    if all(value > 0 for values in history.loss.values() for value in values):
        _logarithmic(loss, "y")
    validation = history.validation["psnr"]
    psnr.plot(range(1, len(validation) + 1), validation, "o-")
    loss.set_ylabel("training loss")
    psnr.set(xlabel="epoch", ylabel=f"validation PSNR\nof {output}, dB")
    _above(figure)
    return figure


@styled(PAGE)
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


@styled(PAGE)
def sets_chart(sets: Sequence[Results], titles: Mapping[str, str], legend: Legend) -> Figure:
    """Heat map: MSE of each method on each test set, divided by the best constant's; no tile without both."""
    methods = with_structure(dict.fromkeys(method for one in sets for method in one.metrics))
    errors = [[one.metrics.get(row, {}).get("mse") for one in sets] for row in [*methods, "oracle_mean"]]
    known = np.array(errors, float)  # not a number where an error is unknown
    ratios = known[:-1] / known[-1]
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


@styled(LIGHT)
def parallel_coordinates(values: Mapping[str, Sequence[str]], scores: Sequence[float], score_label: str) -> Figure:
    """One axis for each swept key and one for the score; the line of the lowest score is drawn last and thick.

    `values` has a value for each point, by key. An axis spaces them evenly: numbers by size, words as they appear.
    """
    figure = Figure(figsize=(2.2 * (len(values) + 1), 3.6), layout="constrained", facecolor=LIGHT.face)
    axes = figure.subplots()
    colours, scaled = matplotlib.colormaps["viridis_r"], Normalize(min(scores), max(scores))
    heights = [_height_of(column) for column in values.values()]
    span = max(scores) - min(scores) or 1.0
    for number in sorted(range(len(scores)), key=lambda number: -scores[number]):
        levels = [height[column[number]] for height, column in zip(heights, values.values(), strict=True)]
        levels.append((scores[number] - min(scores)) / span)
        best = number == int(np.argmin(scores))
        axes.plot(levels, color=colours(scaled(scores[number])), linewidth=3.0 if best else 1.3)
    heights.append({f"{min(scores):.4f}": 0.0, f"{max(scores):.4f}": 1.0})
    for place, height in enumerate(heights):
        for value, level in height.items():
            axes.text(place + 0.04, level, value, fontsize=8, va="bottom", color=LIGHT.text)
    axes.set_xticks(range(len(values) + 1), [*values, score_label], fontsize=8)
    axes.set(yticks=[], xlim=(-0.2, len(values) + 0.5))
    axes.grid(axis="x")
    return figure


def _height_of(column: Sequence[str]) -> dict[str, float]:
    """Place of each value on its axis, from 0 to 1."""
    distinct = list(dict.fromkeys(column))
    with contextlib.suppress(ValueError):
        distinct.sort(key=float)
    return {value: place / max(len(distinct) - 1, 1) for place, value in enumerate(distinct)}
