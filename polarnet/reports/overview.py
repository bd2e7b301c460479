"""The whole pipeline in one figure: photograph, polarization, four polarizers, four event streams, recovered DoLP."""

from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from polarnet.events.stream import Events
from polarnet.reports.artefacts import Overview
from polarnet.reports.figures import LIGHT, chart_style, draw_wheel, show_picture
from polarnet.reports.maps import dolp_image, intensity_image, polarization_hsv
from polarnet.stokes import POLARIZER_ANGLES_DEG

ON, OFF = "#d0312d", "#1f5fb8"
MAX_EVENTS = 25_000  # drawn per stream; above this number, every k-th event is drawn
# The sheet, in inches. README pages show it about 900 pixels wide: hence few columns and large letters.
HEIGHT = 4.45
TOP, BOTTOM = 4.0, 0.2
GAP = 0.12
LARGE, MEDIUM, SMALL = ((TOP - BOTTOM - (rows - 1) * GAP) / rows for rows in (2, 3, 4))  # heights of the pictures
MARGIN = 0.15
ARROW = 0.68
PICTURE_WIDTH = 2.0
STREAM_WIDTH = 2.1


def overview_figure(overview: Overview) -> Figure:
    """Draw the pipeline from left to right, with the data of one sequence."""
    height, width = overview.dolp.shape
    with matplotlib.rc_context(chart_style(LIGHT)):
        pictures = (LARGE + MEDIUM + SMALL) * width / height + PICTURE_WIDTH + STREAM_WIDTH
        figure = Figure(figsize=(pictures + 4 * ARROW + 2 * MARGIN, HEIGHT), facecolor=LIGHT.face)
        x = MARGIN
        _source(figure, x, overview)
        x = _arrow(figure, x + PICTURE_WIDTH, "HSV")
        _heading(figure, x, "polarization")
        full = torch.ones_like(overview.dolp)
        _picture(figure, x, _row(0, MEDIUM), MEDIUM, dolp_image(overview.dolp), "DoLP")
        _picture(figure, x, _row(1, MEDIUM), MEDIUM, polarization_hsv(full, full, overview.aolp), "AoLP")
        _picture(figure, x, _row(2, MEDIUM), MEDIUM, intensity_image(overview.intensity[::2].sum(0)), "S0")
        x = _arrow(figure, x + MEDIUM * width / height, "Eq. 4")
        _heading(figure, x, "polarizers")
        for i, angle in enumerate(POLARIZER_ANGLES_DEG):
            _picture(figure, x, _row(i, SMALL), SMALL, intensity_image(overview.intensity[i]), f"{angle}°")
        x = _arrow(figure, x + SMALL * width / height, "motion,\nDVS")
        _heading(figure, x, f"events, {overview.duration_us / 1000:.0f} ms")
        for i, stream in enumerate(overview.streams):
            _cloud(_place(figure, x, _row(i, SMALL), STREAM_WIDTH, SMALL), stream, overview)
        x = _arrow(figure, x + STREAM_WIDTH, "network")
        _heading(figure, x, "DoLP")
        _picture(figure, x, _row(0, LARGE), LARGE, dolp_image(overview.recovered), "recovered")
        _picture(figure, x, _row(1, LARGE), LARGE, dolp_image(overview.dolp), "truth")
    return figure


def _row(index: int, height: float) -> float:
    """Lower edge of a picture row."""
    return TOP - height - index * (height + GAP)


def _place(figure: Figure, x: float, y: float, width: float, height: float) -> Axes:
    sheet = figure.get_figwidth()
    return figure.add_axes((x / sheet, y / HEIGHT, width / sheet, height / HEIGHT))


def _text(figure: Figure, x: float, y: float, text: str, **style: Any) -> None:
    figure.text(x / figure.get_figwidth(), y / HEIGHT, text, **style)


def _heading(figure: Figure, x: float, text: str) -> None:
    _text(figure, x, TOP + 0.13, text, color=LIGHT.text, fontsize=12.5, weight="bold")


def _picture(figure: Figure, x: float, y: float, height: float, picture: np.ndarray, label: str = "") -> Axes:
    rows, columns = picture.shape[:2]
    axes = _place(figure, x, y, height * columns / rows, height)
    show_picture(axes, picture, LIGHT)
    if label:
        box = {"facecolor": "black", "alpha": 0.55, "edgecolor": "none", "pad": 1.6}
        axes.annotate(label, (0, 1), (4, -4), xycoords="axes fraction", textcoords="offset points", va="top",
                      color="white", fontsize=9.5, bbox=box)  # fmt: skip
    return axes


def _source(figure: Figure, x: float, overview: Overview) -> None:
    """Draw the picture with the sensor's path over it, and the key to its colours below."""
    rows, columns = overview.picture.shape[:2]
    height = PICTURE_WIDTH * rows / columns
    _heading(figure, x, "picture")
    axes = _picture(figure, x, TOP - height, height, overview.picture)
    for line in (overview.outline, overview.path):
        across, down = line * np.array([[columns], [rows]])
        axes.plot(across, down, color="black", linewidth=2.4, alpha=0.6)
        axes.plot(across, down, color="white", linewidth=1.2)
    axes.set(xlim=(0, columns), ylim=(rows, 0))
    draw_wheel(_place(figure, x + 0.4, 1.0, 1.2, 1.2), size=480, label_size=9.0)
    text = "hue → AoLP\nsaturation → DoLP\nvalue → S0"
    style: dict[str, Any] = {"color": LIGHT.quiet, "fontsize": 9.5, "ha": "center", "va": "center", "linespacing": 1.5}
    _text(figure, x + PICTURE_WIDTH / 2, 0.52, text, **style)


def _arrow(figure: Figure, x: float, text: str) -> float:
    """Draw an arrow to the next column, labelled with the processing step; returns the column's left edge."""
    middle = (TOP + BOTTOM) / 2
    ends = [((x + inset) / figure.get_figwidth(), middle / HEIGHT) for inset in (0.1, ARROW - 0.1)]
    figure.add_artist(FancyArrowPatch(*ends, transform=figure.transFigure, arrowstyle="-|>", mutation_scale=14,
                                      color=LIGHT.quiet, linewidth=1.6, shrinkA=0, shrinkB=0))  # fmt: skip
    _text(figure, x + ARROW / 2, middle + 0.1, text, ha="center", va="bottom", color=LIGHT.quiet, fontsize=9.5)
    return x + ARROW


def _cloud(axes: Axes, events: Events, overview: Overview) -> None:
    """Draw events in space and time: the sensor seen from the side, time running to the right."""
    step = max(1, -(-len(events) // MAX_EVENTS))
    t, x, y, p = (column.numpy(force=True)[::step] for column in (events.t, events.x, events.y, events.p))
    across, up = _oblique((t - overview.start_us) / overview.duration_us, x / events.width, y / events.height)
    axes.scatter(across, up, s=0.4, c=np.where(p > 0, ON, OFF), alpha=0.5, linewidths=0)
    for time in (0.0, 1.0):
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], dtype=float)
        axes.plot(*_oblique(np.full(5, time), corners[:, 0], corners[:, 1]), color=LIGHT.quiet, linewidth=0.6)
    for corner in ((0.0, 1.0), (1.0, 1.0), (0.0, 0.0), (1.0, 0.0)):
        axes.plot(*_oblique(np.array([0.0, 1.0]), *(np.full(2, c) for c in corner)), color=LIGHT.grid, linewidth=0.6)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.03, 1.03))
    axes.axis("off")


def _oblique(time: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position on the page of a point in the space-time box (all coordinates 0 to 1, y down)."""
    return 0.72 * time + 0.28 * x, 0.72 * (1 - y) + 0.28 * x
