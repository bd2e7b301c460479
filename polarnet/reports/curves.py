"""Figures of studies: the event budget (paper, Fig. 11), the sensitivity to sensor and motion, and sweeps."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from polarnet.reports.figures import LIGHT, chart_style
from polarnet.reports.legend import GENERAL, in_order

PAPER_EVENTS_PER_PIXEL = 1.04  # events per pixel at which the paper's recovery is good (section 5)
SETTING_LABELS = {
    "threshold_mismatch": "threshold mismatch between pixels, log intensity",
    "noise_rate_hz": "shot noise, events per pixel and second",
    "speed": "speed, times the configured",
    "channel_error": "threshold error between polarizers",
}


def event_budget_figure(results: Mapping[str, Any]) -> Figure:
    """Draw PSNR (dB) and correlation of DoLP against events per pixel since the start, and against window length.

    The third column has frames more often than windows: from overlapping windows, against the events per pixel in one,
    and, as a dashed line, carried on by motion and events. `results` is the content of event_budget.json.
    """
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure = Figure(figsize=(9.6, 5.0), layout="constrained", facecolor="none")
        axes = figure.subplots(2, 3, sharey="row")
        for row, (metric, label) in enumerate((("psnr", "PSNR, dB"), ("corr", "correlation"))):
            start, length, sliding = axes[row]
            _lines(start, results["since_start"], "events_per_pixel", metric)
            start.axvline(PAPER_EVENTS_PER_PIXEL, color=LIGHT.quiet, linewidth=0.9, linestyle="--")
            _log_ticks(start, [entry["events_per_pixel"] for entry in _first(results["since_start"])])
            _lines(length, results["window_length"], "window_us", metric, scale=1e-3)
            _log_ticks(length, [entry["window_us"] / 1000 for entry in _first(results["window_length"])])
            for carry, marker in ((False, "o"), (True, "s")):
                entries = [entry for entry in results["sliding"] if entry["carry"] is carry]
                sliding.plot(
                    [entry["events_per_pixel"] for entry in entries],
                    [entry[metric] for entry in entries],
                    marker=marker,
                    markersize=3.5,
                    color=GENERAL.colour("ours"),
                    linestyle="-" if carry else ":",
                    label="state carried on" if carry else "each window alone",
                )
            between = results["between"]
            label_of_line = f"carried on between windows of {between['window_us'] / 1000:.0f} ms"
            sliding.axhline(
                between[metric], color=GENERAL.colour("ours"), linewidth=1.4, linestyle="--", label=label_of_line
            )
            _log_ticks(sliding, sorted({entry["events_per_pixel"] for entry in results["sliding"]}))
            start.set_ylabel(label)
        axes[0][0].set_title("since the start (dashed: the paper's 1.04)", loc="left", fontsize=9)
        axes[0][1].set_title("by window length", loc="left", fontsize=9)
        spacing = results["sliding"][0]["spacing_us"] if results["sliding"] else 0
        axes[0][2].set_title(f"ours, a frame every {spacing / 1000:g} ms", loc="left", fontsize=9)
        labels = ("events per pixel", "window, ms", "events per pixel in the window")
        for axis, name in zip(axes[1], labels, strict=True):
            axis.set_xlabel(name)
        axes[0][0].legend(frameon=False, fontsize=7, labelcolor=LIGHT.text)
        axes[0][2].legend(frameon=False, fontsize=7, labelcolor=LIGHT.text)
    return figure


def sensitivity_figure(results: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """PSNR and correlation against each setting, one column per setting."""
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure = Figure(figsize=(2.7 * len(results) + 0.4, 4.6), layout="constrained", facecolor="none")
        axes = figure.subplots(2, len(results), sharey="row", squeeze=False)
        for column, (setting, entries) in enumerate(results.items()):
            for row, metric in enumerate(("psnr", "corr")):
                for method in in_order(entries[0]["scores"]):
                    values = [entry["scores"][method][metric] for entry in entries]
                    _line(axes[row][column], method, range(len(entries)), values)
                axes[row][column].set_xticks(range(len(entries)), [f"{entry['value']:g}" for entry in entries])
            axes[1][column].set_xlabel(SETTING_LABELS.get(setting, setting), fontsize=7)
        axes[0][0].set_ylabel("PSNR, dB")
        axes[1][0].set_ylabel("correlation")
        axes[0][-1].legend(frameon=False, fontsize=7, labelcolor=LIGHT.text)
    return figure


def _lines(
    axes: Axes, of_methods: Mapping[str, Sequence[Mapping[str, Any]]], x: str, y: str, scale: float = 1.0
) -> None:
    for method in in_order(of_methods):
        entries = of_methods[method]
        _line(axes, method, [scale * entry[x] for entry in entries], [entry[y] for entry in entries])


def _line(axes: Axes, method: str, x: Sequence[float | int], y: Sequence[float | int]) -> None:
    axes.plot(x, y, marker="o", markersize=3, color=GENERAL.colour(method), label=GENERAL.label(method))


def _log_ticks(axes: Axes, values: Sequence[float]) -> None:
    """Make the axis logarithmic, with ticks at the points where there is room."""
    axes.set_xscale("log")
    positive = [value for value in values if value > 0]
    ticks: list[float] = []
    for value in positive:
        if not ticks or np.log(value / ticks[-1]) > np.log(positive[-1] / positive[0]) / 9:
            ticks.append(value)
    axes.set_xticks(ticks, [f"{value:.3g}" if value >= 100 else f"{value:.2g}" for value in ticks])
    axes.xaxis.set_minor_locator(NullLocator())


def _first(of_methods: Mapping[str, Sequence[Mapping[str, Any]]]) -> Sequence[Mapping[str, Any]]:
    return next(iter(of_methods.values()))


def parallel_coordinates(values: Mapping[str, Sequence[str]], scores: Sequence[float], score_label: str) -> Figure:
    """One axis for each swept key and one for the score; the line of the lowest score is drawn last and thick.

    `values` has a value for each point, by key. An axis spaces them evenly: numbers by size, words as they appear.
    """
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure = Figure(figsize=(2.2 * (len(values) + 1), 3.6), layout="constrained", facecolor=LIGHT.face)
        axes = figure.subplots()
        colours, scaled = matplotlib.colormaps["viridis_r"], Normalize(min(scores), max(scores))
        heights = [_height_of(column) for column in values.values()]
        span = max(scores) - min(scores) or 1.0
        for number in sorted(range(len(scores)), key=lambda number: -scores[number]):
            best = number == int(np.argmin(scores))
            levels = [height[column[number]] for height, column in zip(heights, values.values(), strict=True)]
            levels.append((scores[number] - min(scores)) / span)
            axes.plot(levels, color=colours(scaled(scores[number])), linewidth=3.0 if best else 1.3)
        for place, height in enumerate(heights):
            for value, level in height.items():
                axes.text(place + 0.04, level, value, fontsize=8, va="bottom", color=LIGHT.text)
        for level, score in ((0, min(scores)), (1, max(scores))):
            axes.text(len(values) + 0.04, level, f"{score:.4f}", fontsize=8, va="bottom", color=LIGHT.text)
        axes.set_xticks(range(len(values) + 1), [*values, score_label], fontsize=8)
        axes.set_yticks([])
        axes.set_xlim(-0.2, len(values) + 0.5)
        axes.grid(axis="x")
    return figure


def _height_of(column: Sequence[str]) -> dict[str, float]:
    """Place of each value on its axis, from 0 to 1."""
    distinct = list(dict.fromkeys(column))
    with contextlib.suppress(ValueError):
        distinct.sort(key=float)
    return {value: place / max(len(distinct) - 1, 1) for place, value in enumerate(distinct)}
