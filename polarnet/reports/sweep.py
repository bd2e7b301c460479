"""Figure of a sweep: parallel coordinates, one line a point, coloured by its score."""

import contextlib
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from polarnet.reports.figures import Theme, chart_style


def parallel_coordinates(
    values: Mapping[str, Sequence[str]], scores: Sequence[float], score_label: str, theme: Theme
) -> Figure:
    """One axis for each swept key and one for the score; the line of the lowest score is drawn last and thick.

    `values` has a value for each point, by key. An axis spaces them evenly: numbers by size, words as they appear.
    """
    with matplotlib.rc_context(chart_style(theme)):
        figure = Figure(figsize=(2.2 * (len(values) + 1), 3.6), layout="constrained", facecolor=theme.face)
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
                axes.text(place + 0.04, level, value, fontsize=8, va="bottom", color=theme.text)
        for level, score in ((0, min(scores)), (1, max(scores))):
            axes.text(len(values) + 0.04, level, f"{score:.4f}", fontsize=8, va="bottom", color=theme.text)
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
