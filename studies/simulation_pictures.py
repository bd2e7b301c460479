"""Pictures of docs/simulation.md and docs/physics.md: python -m studies.simulation_pictures [FOLDER]

Every line and every event in them comes from the simulation itself.
"""

import argparse
import io
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from polarnet.events.stream import Events, select, slice_time
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.images import read_rgb
from polarnet.reports.figures import LIGHT, styled
from polarnet.reports.maps import png
from polarnet.simulation.emulator import EmulatorConfig, emulate
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.scene import PolarizationScene, scene_from_rgb
from studies.study import PICTURES

ON, OFF = "#d0312d", "#1f5fb8"
PHOTO = next(photo.path for photo in BUILTIN_PHOTOS if photo.file == "coffee.png")
DURATION_MS = 500
RATE_HZ = 2000.0  # sampling rate of the light on the pixel
PIXELS = 12  # number of pixels side by side under the same light, to show their differences
QUIET = replace(SENSORS["clean"], contrast_threshold_sigma_on=0.0, contrast_threshold_sigma_off=0.0)
COLOURS = 96  # palette size of a picture on disk
LINE: dict[str, Any] = {"color": LIGHT.quiet, "linewidth": 1.3}


THRESHOLDS = ("contrast_threshold_on", "contrast_threshold_off")
VARIATIONS = {
    "contrast threshold": (THRESHOLDS, (0.1, 0.2, 0.4), ""),
    "photoreceptor bandwidth": (("cutoff_hz",), (0.0, 100.0, 20.0), " Hz"),
    "refractory period": (("refractory_period_us",), (0.0, 5_000.0, 30_000.0), " µs"),
    "leak": (("leak_rate_hz",), (0.0, 5.0, 20.0), " Hz"),
    "shot noise": (("shot_noise_rate_hz",), (0.0, 20.0, 80.0), " Hz"),
}
"""Parameters of the pixel, and their values and unit in a picture."""


def drawn(width: float, height: float) -> Callable[[Callable[[Figure], None]], Callable[[], Figure]]:
    """Decorator: `draw(figure)` becomes a function that returns the figure, in the style of docs; sizes in inches."""

    def of(draw: Callable[[Figure], None]) -> Callable[[], Figure]:
        @styled(LIGHT)
        def make() -> Figure:
            figure = Figure(figsize=(width, height), layout="constrained", facecolor=LIGHT.face)
            draw(figure)
            return figure

        return make

    return of


def light_of_one_pixel(t_ms: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Light on one pixel in digital numbers: a slow swell, a quick flash, then steady dim light."""
    swell = 0.7 * (1 - np.cos(2 * math.pi * t_ms.clip(0, 180) / 180)) / 2
    flash = (_edge(t_ms, 230.0) - _edge(t_ms, 290.0)) * 1.3
    return 69 * np.exp(swell + flash - 0.6 * _edge(t_ms, 340.0))


def _edge(t_ms: Float64[np.ndarray, " n"], at_ms: float) -> Float64[np.ndarray, " n"]:
    return ((t_ms - at_ms) / 6).clip(0, 1)


def events_under(light_dn: Float64[np.ndarray, " n"], t_us: Float64[np.ndarray, " n"], config: EmulatorConfig,
                 pixels: int = 1, key: int = 5) -> Events:  # fmt: skip
    """Events of neighbouring pixels under one light."""
    frames = torch.from_numpy(light_dn.astype(np.float32))[:, None, None, None].expand(-1, 1, 1, pixels)
    (events,), _ = emulate(frames.contiguous(), torch.from_numpy(t_us), config, key=key)
    return events


def pixel_events(config: EmulatorConfig, rate_hz: float = RATE_HZ, pixels: int = 1) -> Events:
    """Events of neighbouring pixels under the light of `light_of_one_pixel`."""
    t_us = np.rint(np.arange(1 + DURATION_MS * 1e-3 * rate_hz) * 1e6 / rate_hz)
    return events_under(light_of_one_pixel(t_us / 1000), t_us, config, pixels, key=3)


@drawn(9.0, 5.2)
def parameters_figure(figure: Figure) -> None:
    """Draw one pixel's events for several values of each physical parameter."""
    t_ms = np.linspace(0, DURATION_MS, 2001)
    panels = figure.subplots(2, 3, sharex=True).ravel()
    for axes, (title, (names, values, unit)) in zip(panels, VARIATIONS.items(), strict=False):
        _light(axes, t_ms, title)
        for row, value in enumerate(values):
            changed: dict[str, Any] = dict.fromkeys(names, value)
            _ticks(axes, pixel_events(replace(QUIET, **changed)), row)
        off = "∞ Hz" if "cutoff_hz" in names else f"0{unit}"
        labels = [f"{value:g}{unit}" if value else off for value in values]
        axes.set_yticks([row + 0.4 for row in range(len(values))], labels)
    _light(panels[-1], t_ms, "mismatch 0.05: twelve pixels, one light")
    mismatched = replace(QUIET, contrast_threshold_sigma_on=0.05, contrast_threshold_sigma_off=0.05)
    events = pixel_events(mismatched, pixels=PIXELS)
    for pixel in range(PIXELS):
        _ticks(panels[-1], select(events, events.x == pixel), 3 * pixel / PIXELS, 2.4 / PIXELS)
    panels[-1].set_yticks([])
    for axes in panels[3:]:
        axes.set_xlabel("ms")


@drawn(9.0, 2.9)
def crossings_figure(figure: Figure) -> None:
    """Draw the threshold crossings of log intensity, and their times by `exact` and `v2e`, from frames at 60 Hz."""
    rate_hz, threshold = 60.0, QUIET.contrast_threshold_on
    frames_ms = np.arange(0, 200, 1000 / rate_hz)
    t_ms = np.linspace(0, frames_ms[-1], 2001)
    log = np.interp(t_ms, frames_ms, np.log(light_of_one_pixel(frames_ms)))
    curve, stamps = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    curve.plot(t_ms, log, **LINE)
    curve.plot(frames_ms, np.log(light_of_one_pixel(frames_ms)), "o", color=LIGHT.text, markersize=3)
    events = slice_time(pixel_events(QUIET, rate_hz), 0, int(1000 * t_ms[-1]))
    for t, p in zip(events.t.numpy() / 1000, events.p.numpy(), strict=True):
        level = float(np.interp(t, t_ms, log))
        curve.plot([0, t], [level, level], color=LIGHT.grid, linewidth=0.8, zorder=0)
        curve.plot([t], [level], "^" if p > 0 else "v", color=ON if p > 0 else OFF, markersize=6)
    curve.set_ylabel("ln light")
    curve.set_title(f"a step of {threshold:g} in log light is an event; dots: frames at 60 Hz", loc="left", fontsize=9)
    curve.grid(axis="y", visible=False)
    for row, model in enumerate(("exact", "v2e")):
        drawn_events = slice_time(pixel_events(replace(QUIET, model=model), rate_hz), 0, int(1000 * t_ms[-1]))
        _ticks(stamps, drawn_events, row, 0.7)
    stamps.set_yticks([0.35, 1.35], ["exact", "v2e"])
    stamps.set(ylim=(1.9, -0.2), xlabel="ms", xlim=(0, t_ms[-1]))
    stamps.grid(visible=False)


def _light(axes: Axes, t_ms: Float64[np.ndarray, " n"], title: str) -> None:
    """Draw log light on the upper half of a panel; rows of events come below."""
    log = np.log(light_of_one_pixel(t_ms))
    axes.plot(t_ms, -0.3 - 2.2 * (log - log.min()) / np.ptp(log), **LINE)
    axes.set_title(title, loc="left", fontsize=9)
    axes.set(ylim=(3.2, -2.8), xlim=(0, DURATION_MS))
    axes.grid(visible=False)
    axes.tick_params(axis="y", length=0)


def _ticks(axes: Axes, events: Events, row: float | int, height: float = 0.8) -> None:
    for polarity, colour in ((1, ON), (-1, OFF)):
        t_ms = events.t[events.p == polarity].numpy() / 1000
        axes.vlines(t_ms, row, row + height, color=colour, linewidth=1.1)


def photograph() -> PolarizationScene:
    """The scene of the pictures: a built-in photograph."""
    return scene_from_rgb(read_rgb(PHOTO))


def few_colours(content: bytes, colours: int = COLOURS) -> bytes:
    """Reduce the picture to a palette: a third of the bytes, without a visible difference."""
    buffer = io.BytesIO()
    picture = Image.open(io.BytesIO(content)).convert("RGB")
    picture.quantize(colours, dither=Image.Dither.NONE).save(buffer, format="png", optimize=True)
    return buffer.getvalue()


FIGURES = {
    "simulation_parameters": parameters_figure,
    "simulation_crossings": crossings_figure,
}


def write_pictures(
    figures: Mapping[str, Callable[[], Figure]],
    about: str,
    encode: Callable[[bytes], bytes] = few_colours,
    suffix: str = "png",
) -> None:
    """Command line of a module of pictures: write every figure as NAME.SUFFIX, encoded from PNG, into a folder."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("folder", type=Path, nargs="?", default=PICTURES, help="default: that of docs")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        path = folder / f"{name}.{suffix}"
        path.write_bytes(encode(png(figure())))
        print(f"{path}: {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    write_pictures(FIGURES, "Draw pictures of docs/simulation.md and docs/physics.md.")
