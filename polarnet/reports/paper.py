"""The paper's Table 2 and its figures 9, 10 and 11 from a run, as files that a text can include."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from polarnet.reports.artefacts import Results
from polarnet.reports.figures import LIGHT, chart_style, comparison_figure, show_picture, tile_grid
from polarnet.reports.legend import Legend
from polarnet.reports.maps import dolp_image, event_full_scale, event_image, write_figure
from polarnet.reports.tables import COLUMNS, Row, Scores, Table, as_csv, as_latex, as_markdown, score_table

METHODS = ("cf", "e2v", "e2vid_published", "paper", "ours")
"""Rows of Table 2 and columns of figures 9 and 10, if they were run; the paper has CF, E2V and its network."""
METRICS = ("mse", "psnr", "ssim", "lpips")
EXPERIMENTS = {"recordings": "Real", "simulated": "Simulated"}
"""Heading of each half of Table 2, by test set."""
FIGURES = {"recordings": "figure_9", "simulated": "figure_10"}


def write_paper_files(folder: Path, results: Sequence[Results], legend: Legend) -> None:
    """Write figures 9 and 10 for the test sets with panels, and Table 2 (.md, .csv, .tex) if both sets were scored."""
    sets = {one.name: one for one in results if one.name in EXPERIMENTS}
    for name, one in sets.items():
        if one.panels:
            methods = [row for row in METHODS if row in one.panels[0].predictions]
            write_figure(comparison_figure(one.panels, methods, legend), folder / FIGURES[name])
    if set(sets) == set(EXPERIMENTS) and set(METHODS).intersection(*(one.metrics for one in sets.values())):
        warmup_windows = sets["simulated"].details["warmup_windows"]
        table = table_2(sets["recordings"].metrics, sets["simulated"].metrics, legend, warmup_windows)
        groups = tuple(EXPERIMENTS.values())
        folder.mkdir(parents=True, exist_ok=True)
        for kind, text in (
            ("md", as_markdown(table, groups)), ("csv", as_csv(table, groups)), ("tex", as_latex(table, groups))
        ):  # fmt: skip
            (folder / f"table_2.{kind}").write_text(text + "\n", encoding="utf-8")


def table_2(real: Scores, simulated: Scores, legend: Legend, warmup_windows: int) -> Table:
    """The paper's Table 2: real and simulated scores side by side, with a row for each of `METHODS` in both."""
    rows = [row for row in METHODS if row in real and row in simulated]
    columns = {key: COLUMNS[key] for key in METRICS}
    left, right = (
        score_table(
            {row: {key: one[row].get(key) for key in (*METRICS, "lpips_backbone")} for row in rows},
            columns, legend.labels, warmup_windows,
        )
        for one in (real, simulated)
    )  # fmt: skip
    pairs = zip(left.rows, right.rows, strict=True)
    joined = tuple(Row(a.method, a.label, a.cells + b.cells) for a, b in pairs)
    return Table(left.headings + right.headings, joined, left.notes)


class Moment(NamedTuple):
    """A column of Fig. 11: DoLP from the events of one window alone, without a state."""

    t_us: int
    """Time of the window's last event."""
    events: int
    """Mean number of events of a channel."""
    tensor: Float[Tensor, "h w"]
    """Event tensor (Eq. 5) of the channel at 0 degrees."""
    recovered: Float[Tensor, "h w"]
    truth: Float[Tensor, "h w"]


def figure_11(moments: Sequence[Moment]) -> Figure:
    """Draw event tensors, the DoLP recovered from them and the true DoLP, with t and n above each column."""
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure, grid = tile_grid(3, len(moments), moments[0].truth.shape, bar_row=1)
        for k, moment in enumerate(moments):
            tensor = event_image(moment.tensor, event_full_scale(moment.tensor))
            for axes, picture in zip(
                grid[:, k], (tensor, dolp_image(moment.recovered), dolp_image(moment.truth)), strict=True
            ):
                show_picture(axes, picture, LIGHT)
            label = f"t = {moment.t_us / 1000:.1f} ms, n = {moment.events:,}"
            grid[0, k].set_title(label, color=LIGHT.text, fontsize=6.5, pad=3)
        for axes, name in zip(grid[:, 0], ("event tensor", "recovered", "truth"), strict=True):
            axes.set_ylabel(name, color=LIGHT.quiet, fontsize=6.5)
    return figure
