"""The pipeline in one figure: photograph, polarization, four polarizers, four event streams, recovered DoLP.

`studies.measure` draws it into docs/pictures/overview.png, from a run of the demo.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from torch import Tensor

from polarnet.events.stream import Events
from polarnet.pictures.manifest import read_manifest
from polarnet.reports.figures import LIGHT, chart_style, show_picture
from polarnet.reports.maps import dolp_image, intensity_image, polarization_hsv
from polarnet.simulation.motion import Trajectory, sensor_to_scene
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.panels import Panel, read_panel
from polarnet.storage.scenes import SceneStore

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


class Overview(NamedTuple):
    """One test sequence, from the picture that the sensor moved over to the DoLP recovered from one window."""

    picture: UInt8[np.ndarray, "height width 3"]
    path: Float[np.ndarray, "2 times"]
    """Path of the sensor's centre over the sequence: x and y in pixels of the picture."""
    outline: Float[np.ndarray, "2 corners"]
    """Outline of the sensor at the end, in the same pixels."""
    intensity: Float[Tensor, "4 h w"]
    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"]
    streams: Sequence[Events]
    """Events of the four channels, from `start_us` on."""
    start_us: int
    duration_us: int
    recovered: Float[Tensor, "h w"]


def overview_of(data: Path) -> Overview:
    """The panel of a photograph with the most varied DoLP, from the outputs of a pipeline in `data`."""
    scenes = SceneStore.open(data / "scenes.zarr")
    panels = [read_panel(path) for path in sorted((data / "benchmark/sets/simulated/panels").glob("*.npz"))]
    photographs = {one.name for one in read_manifest(data / "images").pictures if one.source == "photograph"}
    shown = [one for one in panels if scenes.scene_of[one.sequence] in photographs]
    panel = max(shown, key=lambda one: float(one.truth.dolp.std()))
    return overview_of_panel(
        panel, scenes, FrameStore.open(data / "frames.zarr"), EventStore.open(data / "events.zarr")
    )


def overview_of_panel(panel: Panel, scenes: SceneStore, frames: FrameStore, events: EventStore) -> Overview:
    """The window of a panel, with the events and frames behind it."""
    scene = scenes.read(panel.sequence)
    trajectory = Trajectory.from_vector(scene.trajectory.numpy())
    path = trajectory.pose(np.linspace(0, scene.duration_us / 1e6, 200))
    pose = [float(column[0]) for column in trajectory.pose(np.array([panel.t_us / 1e6]))]
    height, width = scenes.sensor_height, scenes.sensor_width
    left, top, along, across = sensor_to_scene(*pose, height, width)
    columns, rows = np.array([[0, width, width, 0, 0], [0, 0, height, height, 0]])
    start_us, frame = int(frames.t_us(panel.sequence)[panel.window]), frames.frames(panel.sequence)
    return Overview(
        picture=polarization_hsv(scene.s0, scene.dolp, scene.aolp),
        path=np.stack([path.x, path.y]),
        outline=np.stack([left + columns * along - rows * across, top + columns * across + rows * along]),
        intensity=frame.intensity[panel.window + 1],
        dolp=frame.dolp[panel.window + 1],
        aolp=frame.aolp[panel.window + 1],
        streams=events.read(panel.sequence, start_us, panel.t_us),
        start_us=start_us,
        duration_us=panel.t_us - start_us,
        recovered=panel.predictions["ours"].dolp,
    )


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
        axes.plot(*line, color="black", linewidth=2.4, alpha=0.6)
        axes.plot(*line, color="white", linewidth=1.2)
    axes.set(xlim=(0, columns), ylim=(rows, 0))
    _wheel(_place(figure, x + 0.4, 1.0, 1.2, 1.2))
    text = "hue → AoLP\nsaturation → DoLP\nvalue → S0"
    style: dict[str, Any] = {"color": LIGHT.quiet, "fontsize": 9.5, "ha": "center", "va": "center", "linespacing": 1.5}
    _text(figure, x + PICTURE_WIDTH / 2, 0.52, text, **style)


def _wheel(axes: Axes) -> None:
    """Draw `hue_wheel`, labelled with AoLP at 0, 45, 90 and 135 degrees."""
    axes.imshow(hue_wheel(480))
    axes.axis("off")
    for angle, (across, up, sideways, upright) in {
        "0°": (1.05, 0.5, "left", "center"), "45°": (0.87, 0.88, "left", "bottom"),
        "90°": (0.5, 1.03, "center", "bottom"), "135°": (0.13, 0.88, "right", "bottom"),
    }.items():  # fmt: skip
        place: dict[str, Any] = {"transform": axes.transAxes, "ha": sideways, "va": upright}
        axes.text(across, up, angle, color=LIGHT.quiet, fontsize=9.0, **place)


def hue_wheel(size: int) -> UInt8[np.ndarray, "size size 4"]:
    """The legend of `polarization_hsv`: direction is AoLP, radius is DoLP, value 1. RGBA, transparent outside.

    Opposite points have the same colour, since both directions of a line are one angle of polarization. Angles count
    anticlockwise from the right, as on paper; the first row is the top.
    """
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis, -axis)
    radius = np.hypot(x, y)
    hue = np.arctan2(y, x) / math.pi % 1.0
    rgb = hsv_to_rgb(np.stack([hue, radius.clip(0, 1), np.ones_like(hue)], axis=-1))
    edge = ((1 - radius) * size / 2).clip(0, 1)  # soft rim, one pixel wide
    return np.rint(255 * np.concatenate([rgb, edge[..., None]], axis=-1)).astype(np.uint8)


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
