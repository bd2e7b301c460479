"""The method in one figure: photograph, polarization, four polarizers, events, recovered DoLP.

`python -m studies.overview [FOLDER]` draws docs/pictures/overview.webp: a simulated second over a built-in photograph,
and what the shipped network makes of it. The background is transparent and labels are grey, for light and dark pages.
"""

import io

import numpy as np
import torch
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from polarnet.events.stream import Events, slice_time
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.images import read_rgb
from polarnet.recovery import recover
from polarnet.reports.figures import LIGHT, show_picture
from polarnet.reports.maps import dolp_image, intensity_image, polarization_hsv
from polarnet.simulation.motion import Trajectory, sensor_to_scene
from polarnet.simulation.presets import MOTIONS, SENSORS
from polarnet.simulation.sequence import simulate
from polarnet.stokes import POLARIZER_ANGLES_DEG
from studies.simulation_pictures import drawn, write_pictures

PHOTO = next(photo.path for photo in BUILTIN_PHOTOS if photo.path.stem.startswith("motorcycle"))
WINDOW = 24  # of 30; the figure shows its events, and the frames at its end
SEED = 7
MAX_EVENTS = 25_000  # drawn of each channel; above this number, every k-th event is drawn
WIDTHS = 2.3, 2.0, 1.5, 2.2, 2.9
LABEL = "#768390"  # contrast 3.9 on white, 4.8 on a dark page
ON, OFF = "#e5534b", "#4a8ce0"  # visible on white and on a dark page
QUALITY, WIDTH = 80, 1560  # of WebP; twice the width of a page of GitHub
KEY = "hue → AoLP\nsaturation → DoLP\nvalue → S0"


@drawn(13.0, 4.9)
def overview_figure(figure: Figure) -> None:
    """Draw the way of one window from left to right."""
    figure.set_facecolor("none")
    picture = read_rgb(PHOTO)
    simulation = simulate(picture, MOTIONS["default"], SENSORS["default"], SEED)
    start_us, stop_us = simulation.t_us[WINDOW : WINDOW + 2].tolist()
    intensities, dolp, aolp = (one[WINDOW + 1] for one in (simulation.intensities, simulation.dolp, simulation.aolp))
    recovered = recover(simulation.events, t_us=simulation.t_us).prediction.dolp[WINDOW]
    full, s0 = torch.ones_like(dolp), intensities[::2].sum(0)
    columns = figure.subfigures(1, len(WIDTHS), squeeze=False, width_ratios=WIDTHS)[0]
    headings = (
        "photograph",
        "→ polarization",
        "→ polarizers",
        f"→ events, {(stop_us - start_us) / 1e3:.0f} ms",
        "→ DoLP",
    )
    for part, heading in zip(columns, headings, strict=True):
        part.set_facecolor("none")
        part.suptitle(heading, color=LABEL, fontsize=13, weight="bold")
    axes = columns[0].subplots()
    show_picture(axes, picture.permute(1, 2, 0).numpy(), LIGHT)
    axes.plot(*sensor_outline(simulation.trajectory, stop_us / 1e6, *dolp.shape), color="white", linewidth=1.5)
    axes.set_xlabel(KEY, color=LABEL, fontsize=11, linespacing=1.6)
    _pictures(columns[1], DoLP=dolp_image(dolp), AoLP=polarization_hsv(full, full, aolp), S0=intensity_image(s0))
    angles = (f"{angle}°" for angle in POLARIZER_ANGLES_DEG)
    _pictures(columns[2], **{angle: intensity_image(one) for angle, one in zip(angles, intensities, strict=True)})
    for axes, events in zip(columns[3].subplots(4, 1), simulation.events, strict=True):
        _cloud(axes, slice_time(events, start_us, stop_us), start_us, stop_us)
    _pictures(columns[4], recovered=dolp_image(recovered), truth=dolp_image(dolp))


def sensor_outline(trajectory: Trajectory, t_s: float, height: int, width: int) -> Float64[np.ndarray, "2 5"]:
    """Columns and rows of the scene at the corners of the sensor, the first one twice, at a time in seconds."""
    pose = [float(value[0]) for value in trajectory.pose(np.array([t_s]))]
    left, top, along, across = sensor_to_scene(*pose, height, width)
    columns, rows = np.array([[0, 1, 1, 0, 0], [0, 0, 1, 1, 0]]) * np.array([[width - 1], [height - 1]])
    return np.stack([left + columns * along - rows * across, top + columns * across + rows * along])


def _pictures(figure: Figure, **pictures: np.ndarray) -> None:
    """One picture below the other, each with its label."""
    box = {"facecolor": "black", "alpha": 0.55, "edgecolor": "none", "pad": 1.6}
    for axes, (label, picture) in zip(figure.subplots(len(pictures), 1), pictures.items(), strict=True):
        show_picture(axes, picture, LIGHT)
        axes.text(0.02, 0.97, label, transform=axes.transAxes, va="top", color="white", fontsize=10, bbox=box)


def _cloud(axes: Axes, events: Events, start_us: int, stop_us: int) -> None:
    """Events in space and time: the sensor seen from the side, time running to the right."""
    step = max(1, -(-len(events) // MAX_EVENTS))
    t, x, y, p = (column.numpy()[::step] for column in (events.t, events.x, events.y, events.p))
    time, across, down = (t - start_us) / (stop_us - start_us), x / events.width, y / events.height
    colours = np.where(p > 0, ON, OFF)
    axes.scatter(0.72 * time + 0.28 * across, 0.28 * across - 0.72 * down, s=0.4, c=colours, alpha=0.6, linewidths=0)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    for moment in (0, 0.72):
        axes.plot(moment + 0.28 * corners[:, 0], 0.28 * corners[:, 0] - 0.72 * corners[:, 1], color=LABEL, lw=0.6)
    axes.axis("off")


def webp(content: bytes) -> bytes:
    """A PNG as WebP of `WIDTH`: a third of the bytes, with its transparency."""
    picture, buffer = Image.open(io.BytesIO(content)), io.BytesIO()
    picture.thumbnail((WIDTH, WIDTH))
    picture.save(buffer, format="webp", quality=QUALITY, method=6)
    return buffer.getvalue()


if __name__ == "__main__":
    write_pictures({"overview": overview_figure}, "Draw docs/pictures/overview.webp.", webp, "webp")
