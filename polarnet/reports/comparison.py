"""Methods beside the truth on some scenes, as in the paper's figures 9 and 10."""

import textwrap
from collections.abc import Sequence

from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from polarnet.metrics.similarity import mse, psnr
from polarnet.reports.figures import LIGHT, show_picture, styled, tile_grid
from polarnet.reports.legend import GENERAL, Legend, with_structure
from polarnet.reports.maps import dolp_image, event_full_scale, event_image
from polarnet.storage.panels import Panel

HEADING_LETTERS, NAME_LETTERS = 19, 18  # in a line above and beside a picture


@styled(LIGHT)
def comparison_figure(panels: Sequence[Panel], legend: Legend = GENERAL) -> Figure:
    """Draw panels like the paper's Fig. 9 and 10: a row each, with events, truth and the DoLP of its methods.

    MSE and PSNR stand below each method; methods of one constant value are left out.
    """
    methods = with_structure(panels[0].predictions)
    headings = ["events, 0°", "true DoLP", *(textwrap.fill(legend.label(one), HEADING_LETTERS) for one in methods)]
    figure, grid = tile_grid(len(panels), len(headings), panels[0].s0.shape)
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
