"""The paper's Table 2 and its figures 9 and 10 from a run, as files that a text can include."""

import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from polarnet.metrics.similarity import mse, psnr
from polarnet.reports.artefacts import Results
from polarnet.reports.figures import LIGHT, show_picture, styled, tile_grid
from polarnet.reports.legend import GENERAL, Legend, with_structure
from polarnet.reports.maps import dolp_image, event_full_scale, event_image, write_figure
from polarnet.reports.tables import COLUMNS, Row, Scores, Table, as_latex, score_table
from polarnet.storage.panels import Panel

METHODS = ("cf", "e2v", "e2vid_published", "paper", "ours")
"""Rows of Table 2 and columns of figures 9 and 10, if they were run; the paper has CF, E2V and its network."""
METRICS = ("mse", "psnr", "ssim", "lpips")
EXPERIMENTS = {"recordings": "Real", "simulated": "Simulated"}
"""Heading of each half of Table 2, by test set."""
FIGURES = {"recordings": "figure_9", "simulated": "figure_10"}
HEADING_LETTERS, NAME_LETTERS = 19, 18  # in a line above and beside a picture


def write_paper_files(folder: Path, results: Sequence[Results], legend: Legend) -> None:
    """Write figures 9 and 10 for the test sets with panels, and Table 2 as LaTeX if both sets were scored."""
    sets = {one.name: one for one in results if one.name in EXPERIMENTS}
    for name, one in sets.items():
        if one.panels:
            methods = [row for row in METHODS if row in one.panels[0].predictions]
            write_figure(comparison_figure(one.panels, methods, legend), folder / FIGURES[name])
    if set(sets) == set(EXPERIMENTS) and set(METHODS).intersection(*(one.metrics for one in sets.values())):
        warmup_windows = sets["simulated"].details["warmup_windows"]
        table = table_2(sets["recordings"].metrics, sets["simulated"].metrics, legend, warmup_windows)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "table_2.tex").write_text(as_latex(table, [*EXPERIMENTS.values()]) + "\n", encoding="utf-8")


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
    joined = [Row(a.method, a.label, a.cells + b.cells) for a, b in zip(left.rows, right.rows, strict=True)]
    return Table(left.headings + right.headings, tuple(joined), left.notes)


@styled(LIGHT)
def comparison_figure(panels: Sequence[Panel], methods: Iterable[str], legend: Legend = GENERAL) -> Figure:
    """Draw panels like the paper's Fig. 9 and 10: a row each, with events, truth and the DoLP of `methods`.

    MSE and PSNR stand below each method; methods of one constant value are left out.
    """
    methods = with_structure(methods)
    headings = ["events, 0°", "true DoLP", *(textwrap.fill(legend.label(one), HEADING_LETTERS) for one in methods)]
    lines = max(1 + heading.count("\n") for heading in headings)
    figure, grid = tile_grid(len(panels), len(headings), panels[0].s0.shape, heading_lines=lines)
    for panel, row in zip(panels, grid, strict=True):
        tiles = [(event_image(panel.events[0], event_full_scale(panel.events)), ""), (dolp_image(panel.truth.dolp), "")]
        shown = [panel.predictions[method].dolp for method in methods]
        tiles += [(dolp_image(dolp), score_line(dolp, panel.truth.dolp)) for dolp in shown]
        for axes, (picture, below) in zip(row, tiles, strict=True):
            show_picture(axes, picture, LIGHT)
            axes.set_xlabel(below, fontsize=6, labelpad=2.5)
        name = panel.sequence
        row[0].set_ylabel(name if len(name) <= NAME_LETTERS else name[: NAME_LETTERS - 1] + "…", fontsize=6)
    for axes, heading in zip(grid[0], headings, strict=True):
        axes.set_title(heading, fontsize=8, pad=4)
    return figure


def score_line(recovered: Float[Tensor, "h w"], truth: Float[Tensor, "h w"]) -> str:
    """MSE and PSNR of one frame, as the text below its picture."""
    error, ratio = (float(score(recovered[None], truth[None])) for score in (mse, psnr))
    return f"{error:.4f} · {ratio:.2f} dB"
