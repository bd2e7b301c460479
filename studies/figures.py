"""Figures of expected errors, of scores under other conditions, and of the sweep over the weights of the loss."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from polarnet.reports.figures import Theme, chart_style
from polarnet.reports.tables import SET_TITLES

SWEEP_SCORES = {
    "mse": ("MSE ↓", -1, 4),
    "psnr": ("PSNR ↑", 1, 2),
    "ssim": ("SSIM ↑", 1, 3),
    "lpips": ("LPIPS ↓", -1, 3),
}
"""Heading, 1 if higher is better and -1 if lower is, decimals."""

ReliabilityCurve = Sequence[tuple[float, float, int]]
"""Predicted squared error, measured squared error and number of pixels of each bin."""


def expected_errors_figure(seeds: Mapping[str, Mapping[str, Any]], theme: Theme) -> Figure:
    """Measured against expected squared error of DoLP, a column per set of scenes and a line per seed.

    `seeds` are the entries of docs/results/expected_errors.json by seed number.
    """
    sets = list(dict.fromkeys(name for results in seeds.values() for name in results["sets"]))
    with matplotlib.rc_context(chart_style(theme)):
        figure = Figure(figsize=(3.5 * len(sets), 3.2), layout="constrained", facecolor="none")
        colours = matplotlib.rcParams["axes.prop_cycle"].by_key()["color"]
        for axes, name in zip(figure.subplots(1, len(sets), squeeze=False)[0], sets, strict=True):
            lines = [
                (f"seed {seed}", colour, results["sets"][name]["curve"])
                for (seed, results), colour in zip(seeds.items(), itertools.cycle(colours), strict=False)
            ]
            _draw_reliability(axes, lines, theme)
            axes.set_title(SET_TITLES[name], loc="left", fontsize=9)
    return figure


def _draw_reliability(axes: Axes, lines: Sequence[tuple[str, str, ReliabilityCurve]], theme: Theme) -> None:
    """Draw measured against predicted squared error, and the diagonal; a line has label, colour and curve."""
    ends = [value for _, _, curve in lines for predicted, measured, _ in curve for value in (predicted, measured)]
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


def _plain_log_ticks(axis: Axis) -> None:
    """Label 1, 2 and 5 of each decade in plain notation: 0.05, not 5 x 10^-2."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_locator(NullLocator())


def loss_sweep_figure(points: Sequence[Mapping[str, Any]], theme: Theme) -> Figure:
    """Test scores by the weights of Eq. 9: a row per score, a column per MSE weight, SSIM against LPIPS weights inside.

    `points` are those of docs/results/sweep.json. Lighter is better, the best of a score is bold, and the frame marks
    the point with the smallest validation MSE. Combinations that were not trained stay empty.
    """
    scores = [key for key in SWEEP_SCORES if any(key in point["test"] for point in points)]
    mse, ssim, lpips = (sorted({point["weights"][name] for point in points}) for name in ("mse", "ssim", "lpips"))
    chosen = min(points, key=lambda point: point["validation"]["mse"]["mean"])
    with matplotlib.rc_context(chart_style(theme)):
        size = (1.0 + 0.85 * len(lpips) * len(mse), 0.9 + (0.45 + 0.42 * len(ssim)) * len(scores))
        figure = Figure(figsize=size, layout="constrained", facecolor="none")
        for row, key in zip(figure.subplots(len(scores), len(mse), squeeze=False), scores, strict=True):
            label, sign, decimals = SWEEP_SCORES[key]
            values = {id(point): point["test"][key]["mean"] for point in points if key in point["test"]}
            best = max(values.values(), key=lambda value: sign * value)
            low, high = min(sign * value for value in values.values()), max(sign * value for value in values.values())
            for axes, weight in zip(row, mse, strict=True):
                image = np.full((len(ssim), len(lpips)), np.nan)
                for point in points:
                    if point["weights"]["mse"] != weight or id(point) not in values:
                        continue
                    i, j = ssim.index(point["weights"]["ssim"]), lpips.index(point["weights"]["lpips"])
                    value = values[id(point)]
                    image[i, j] = goodness = (sign * value - low) / (high - low) if high > low else 1.0
                    axes.text(
                        j, i, f"{value:.{decimals}f}", ha="center", va="center", fontsize=7,
                        color="black" if goodness > 0.5 else "white", weight="bold" if value == best else "normal",
                    )  # fmt: skip
                    if point is chosen:
                        frame = Rectangle((j - 0.46, i - 0.46), 0.92, 0.92, fill=False, color="#d6336c", linewidth=1.8)
                        axes.add_patch(frame)
                axes.imshow(image, cmap="cividis", vmin=0, vmax=1, aspect="auto")
                axes.grid(False)
                axes.set_xticks(range(len(lpips)), [f"{value:g}" for value in lpips])
                axes.set_yticks(range(len(ssim)), [f"{value:g}" for value in ssim])
                axes.set_title(f"{label}, loss.mse={weight:g}", loc="left", fontsize=8)
            row[0].set_ylabel("loss.ssim")
        for axes in figure.axes[-len(mse) :]:
            axes.set_xlabel("loss.lpips")
    return figure


def robustness_figure(tables: Mapping[str, Mapping[str, Any]], theme: Theme) -> Figure:
    """MSE relative to the oracle mean's: a row for each condition, a column for each row of most conditions' tables.

    `tables` are those of a split in docs/results/robustness.json. Darker is better.
    """
    uses = Counter(row for one in tables.values() for row in one["rows"])
    methods = [name for name, number in uses.items() if name != "oracle_mean" and 2 * number > len(tables)]
    ratios = [[one["rows"].get(m, {}).get("mse_over_oracle_mean", np.nan) for m in methods] for one in tables.values()]
    image = np.log(np.array(ratios, float))
    low, high = np.nanmin(image), np.nanpercentile(image, 90)
    with matplotlib.rc_context(chart_style(theme)):
        size = (2.6 + 0.75 * len(methods), 1.2 + 0.24 * len(tables))
        figure = Figure(figsize=size, layout="constrained", facecolor="none")
        axes = figure.subplots()
        axes.imshow(image, cmap="cividis", vmin=low, vmax=high, aspect="auto")
        for (row, column), value in np.ndenumerate(image):
            if np.isfinite(value):
                ink = "black" if value > (low + high) / 2 else "white"
                axes.text(column, row, f"{np.exp(value):.2f}", ha="center", va="center", fontsize=7, color=ink)
        axes.grid(False)
        axes.set_xticks(range(len(methods)), [name.replace("+", "\n+").replace(", ", ",\n") for name in methods])
        axes.set_yticks(range(len(tables)), [f"{name} ({one['scenes']})" for name, one in tables.items()])
        axes.xaxis.tick_top()
        axes.tick_params(length=0, labelsize=7)
    return figure
