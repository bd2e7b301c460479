"""The picture of `polarnet fit-sensor`: each recording beside its simulated twin."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure, FigureBase

from polarnet.characterization.twin import INTERVAL_EDGES_US, Comparison
from polarnet.reports.figures import LIGHT, styled

LABELS = {"recording": "recording", "twin": "simulated twin"}
WIDTH, HEIGHT = 9.6, 5.2  # inches of a comparison


@styled(LIGHT)
def realism_figure(comparisons: Sequence[Comparison]) -> Figure:
    """Event rate over time, ON/OFF ratio, inter-event intervals and the pixels' rates of recordings and their twins."""
    figure = Figure((WIDTH, HEIGHT * len(comparisons)), layout="constrained", facecolor=LIGHT.face)
    for part, comparison in zip(figure.subfigures(len(comparisons), squeeze=False).flat, comparisons, strict=True):
        _draw(part, comparison)
    return figure


def _draw(part: FigureBase, comparison: Comparison) -> None:
    rate, ratio, intervals, pixels = part.subplots(2, 2).flat
    for key, label in LABELS.items():
        rate.plot(comparison.time_s, comparison.rate_hz[key], label=label)
        intervals.stairs(100 * comparison.intervals[key], INTERVAL_EDGES_US * 1e-3, linewidth=1.5)
        ordered = np.sort(comparison.pixel_rates_hz[key])
        pixels.plot(np.linspace(0, 100, len(ordered)), ordered)
    colours = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"][:2]
    ratio.barh(list(LABELS.values()), [comparison.ratio[key] for key in LABELS], color=colours, height=0.5)
    ratio.invert_yaxis()
    rate.set(xlabel="s", ylabel="events per pixel and second", ylim=(0, None), title="event rate over time")
    ratio.set(title="ON events per OFF event")
    intervals.set(xlabel="ms", ylabel="% of the intervals per bin", xscale="log", title="inter-event intervals")
    if len(filled := np.flatnonzero(sum(comparison.intervals.values()))):
        intervals.set_xlim(INTERVAL_EDGES_US[filled[0]] * 5e-4, INTERVAL_EDGES_US[filled[-1] + 1] * 2e-3)
    pixels.set(xlabel="% of the pixels", ylabel="events per second", ylim=(0, None), title="rates of the pixels")
    pixels.set_yscale("symlog", linthresh=max(1e-3, 1 / comparison.duration_s))
    rate.legend()
    part.suptitle(f"{comparison.name}; without {comparison.hot} hot pixels; clock of {comparison.tick_us} us")
