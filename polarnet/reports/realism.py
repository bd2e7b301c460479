"""The realism page of `polarnet fit-sensor`: each recording beside its simulated twin."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from polarnet.characterization.twin import INTERVAL_EDGES_US, Comparison
from polarnet.reports.figures import PAGE, styled, svg
from polarnet.reports.player import template

LABELS = {"recording": "recording", "twin": "simulated twin"}


def realism_page(
    name: str, rows: Sequence[Sequence[str]], notes: Sequence[str], comparisons: Sequence[Comparison]
) -> str:
    """The page as HTML; `rows` are parameter, estimate, standard error and source. It needs no other file."""
    sections = [(one, svg(realism_figure(one))) for one in comparisons]
    return template("realism.html.jinja").render(title=name, rows=rows, notes=notes, sections=sections)


@styled(PAGE)
def realism_figure(comparison: Comparison) -> Figure:
    """Event rate over time, ON/OFF ratio, inter-event intervals and the pixels' rates of a recording and its twin."""
    figure = Figure(figsize=(9.6, 5.2), layout="constrained", facecolor="none")
    rate, ratio, intervals, pixels = figure.subplots(2, 2).flat
    for key, label in LABELS.items():
        rate.plot(comparison.time_s, comparison.rate_hz[key], label=label)
        intervals.stairs(100 * comparison.intervals[key], INTERVAL_EDGES_US * 1e-3, linewidth=1.5)
        ordered = np.sort(comparison.pixel_rates_hz[key])
        pixels.plot(np.linspace(0, 100, len(ordered)), ordered)
    colours = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"][:2]
    ratio.barh(list(LABELS.values()), [comparison.ratio[key] for key in LABELS], color=colours, height=0.5)
    ratio.invert_yaxis()
    rate.set(xlabel="s", ylabel="events per pixel and second", ylim=(0, None))
    intervals.set(xlabel="ms", ylabel="% of the intervals per bin", xscale="log")
    if len(filled := np.flatnonzero(sum(comparison.intervals.values()))):
        intervals.set_xlim(INTERVAL_EDGES_US[filled[0]] * 5e-4, INTERVAL_EDGES_US[filled[-1] + 1] * 2e-3)
    pixels.set(xlabel="% of the pixels", ylabel="events per second", ylim=(0, None))
    pixels.set_yscale("symlog", linthresh=max(1e-3, 1 / comparison.duration_s))
    for axes, title in (
        (rate, "event rate over time"),
        (ratio, "ON events per OFF event"),
        (intervals, "inter-event intervals of a pixel"),
        (pixels, "rates of the pixels, in order"),
    ):
        axes.set_title(title, loc="left", fontsize=9)
    rate.legend()
    return figure
