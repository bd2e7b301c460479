"""The realism page of `polarnet fit-sensor`: each recording beside its simulated twin."""

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from polarnet.characterization.twin import INTERVAL_EDGES_US, Comparison
from polarnet.reports.figures import PAGE, chart_style
from polarnet.reports.html import svg, template

LABELS = {"recording": "recording", "twin": "simulated twin"}


class FitRow(NamedTuple):
    """A row of the table of estimates, as text."""

    parameter: str
    estimate: str
    error: str
    source: str


def realism_page(name: str, rows: Sequence[FitRow], notes: Sequence[str], comparisons: Sequence[Comparison]) -> str:
    """The page as HTML; it needs no other file and no network."""
    sections = [(one, svg(realism_figure(one))) for one in comparisons]
    return template("realism.html.jinja").render(title=name, rows=rows, notes=notes, sections=sections)


def realism_figure(comparison: Comparison) -> Figure:
    """Event rate over time, ON/OFF ratio, inter-event intervals and the pixels' rates of a recording and its twin."""
    with matplotlib.rc_context(chart_style(PAGE)):
        figure = Figure(figsize=(9.6, 5.2), layout="constrained", facecolor="none")
        rate, ratio, intervals, pixels = figure.subplots(2, 2).flat
        for key, label in LABELS.items():
            rate.plot(comparison.time_s, comparison.rate_hz[key], label=label)
            intervals.stairs(100 * comparison.intervals[key], INTERVAL_EDGES_US * 1e-3, label=label, linewidth=1.5)
            ordered = np.sort(comparison.pixel_rates_hz[key])
            pixels.plot(np.linspace(0, 100, len(ordered)), ordered, label=label)
        colours = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"][:2]
        ratio.barh(list(LABELS.values()), [comparison.ratio[key] for key in LABELS], color=colours, height=0.5)
        ratio.invert_yaxis()
        for axes, title, x, y in (
            (rate, "event rate over time", "s", "events per pixel and second"),
            (ratio, "ON events per OFF event", "", ""),
            (intervals, "inter-event intervals of a pixel", "ms", "% of the intervals per bin"),
            (pixels, "rates of the pixels, in order", "% of the pixels", "events per second"),
        ):
            axes.set_title(title, loc="left", fontsize=9)
            axes.set_xlabel(x)
            axes.set_ylabel(y)
        rate.set_ylim(bottom=0)
        intervals.set_xscale("log")
        filled = np.flatnonzero(sum(comparison.intervals.values()))
        if len(filled):
            intervals.set_xlim(INTERVAL_EDGES_US[filled[0]] * 5e-4, INTERVAL_EDGES_US[filled[-1] + 1] * 2e-3)
        pixels.set_yscale("symlog", linthresh=max(1e-3, 1 / comparison.duration_s))
        pixels.set_ylim(bottom=0)
        rate.legend(frameon=False, fontsize=7, labelcolor=PAGE.text)
    return figure
