"""Draw the pictures of docs: python -m studies.pictures

Every line, event and picture in them comes from the simulation, the shipped weights and the demo; where a formula is
drawn, its label says so. `studies.simulated_rig` draws those of the pages on recordings.
"""

import io
import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from jaxtyping import Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from polarnet.cli import main as polarnet
from polarnet.config.tree import load
from polarnet.events.stream import Events, select, slice_time
from polarnet.methods.intensities import consistent
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.images import read_rgb
from polarnet.recovery import recover
from polarnet.reports.figures import FACE, GREY, GRID, TEXT, show_picture, styled
from polarnet.reports.maps import dolp_image, intensity_image, png, polarization_hsv
from polarnet.simulation.emulator import EmulatorConfig, emulate
from polarnet.simulation.motion import Trajectory, sensor_to_scene
from polarnet.simulation.pixels.light import respond
from polarnet.simulation.pixels.physics import physics_of
from polarnet.simulation.presets import MOTIONS, SENSORS
from polarnet.simulation.scene import scene_from_rgb
from polarnet.simulation.sequence import simulate
from polarnet.stokes import POLARIZER_ANGLES_DEG, dolp, intensities_from_stokes, stokes_from_intensities
from studies.study import PICTURES, ROOT

ON, OFF = "#d0312d", "#1f5fb8"
LINES = ("#1c2330", "#2f7fc1", "#3f9c6d", "#e08a1e")
LINE: dict[str, Any] = {"color": GREY, "linewidth": 1.3}
PALETTE = 128  # number of colours of a picture on disk
QUIET = replace(SENSORS["clean"], contrast_threshold_sigma_on=0.0, contrast_threshold_sigma_off=0.0)

DURATION_MS = 500
RATE_HZ = 2000.0  # sampling rate of the light on the pixel
PIXELS = 12  # number of pixels side by side under the same light, to show their differences
THRESHOLDS = ("contrast_threshold_on", "contrast_threshold_off")
VARIATIONS = {
    "contrast threshold": (THRESHOLDS, (0.1, 0.2, 0.4), ""),
    "photoreceptor bandwidth": (("cutoff_hz",), (0.0, 100.0, 20.0), " Hz"),
    "refractory period": (("refractory_period_us",), (0.0, 5_000.0, 30_000.0), " µs"),
    "leak": (("leak_rate_hz",), (0.0, 5.0, 20.0), " Hz"),
    "shot noise": (("shot_noise_rate_hz",), (0.0, 20.0, 80.0), " Hz"),
}
"""Parameters of the pixel, and their values and unit in a picture."""


@styled
def drawn(draw: Callable[[Figure], None], width: float, height: float) -> Figure:
    """A figure in the style of docs; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor=FACE)
    draw(figure)
    return figure


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


def crossings_figure(figure: Figure) -> None:
    """Draw the threshold crossings of log intensity, and their times by `exact` and `v2e`, from frames at 60 Hz."""
    rate_hz, threshold = 60.0, QUIET.contrast_threshold_on
    frames_ms = np.arange(0, 200, 1000 / rate_hz)
    t_ms = np.linspace(0, frames_ms[-1], 2001)
    log = np.interp(t_ms, frames_ms, np.log(light_of_one_pixel(frames_ms)))
    curve, stamps = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    curve.plot(t_ms, log, **LINE)
    curve.plot(frames_ms, np.log(light_of_one_pixel(frames_ms)), "o", color=TEXT, markersize=3)
    events = slice_time(pixel_events(QUIET, rate_hz), 0, int(1000 * t_ms[-1]))
    for t, p in zip(events.t.numpy() / 1000, events.p.numpy(), strict=True):
        level = float(np.interp(t, t_ms, log))
        curve.plot([0, t], [level, level], color=GRID, linewidth=0.8, zorder=0)
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


COFFEE = next(photo.path for photo in BUILTIN_PHOTOS if photo.file == "coffee.png")
WRONG_FACTORS = (1.0, 0.7, 1.4, 1.1)  # of the intensities behind 0, 45, 90 and 135 degrees
NOISE = 0.02  # relative standard deviation of the intensities
DARKEST = 0.004  # of white; added behind every polarizer, as stray light
SIZE = (200, 300)  # rows and columns of the sensor behind the presets
EVENT_STYLES: tuple[dict[str, Any], ...] = (
    {"color": LINES[0]}, {"color": LINES[2]}, {"color": LINES[3]}, {"color": ON},
    {"color": LINES[1], "linestyle": "--"}, {"color": GREY, "linestyle": ":"},
    {"color": GREY, "linestyle": "-."},
)  # fmt: skip
V2E_NOISE = (0.0551, 0.211)  # deviation, and events of each sign per second in two runs (tests of the emulator's noise)


def gains_figure(figure: Figure) -> None:
    """Draw true DoLP, DoLP with wrong factors of the polarizers, and DoLP with factors from the redundancy."""
    scene = scene_from_rgb(read_rgb(COFFEE))
    top, left = (scene.height - SIZE[0]) // 2, (scene.width - SIZE[1]) // 2
    truth = scene.stokes[:, top : top + SIZE[0], left : left + SIZE[1]].double()
    noise = 1 + NOISE * torch.randn((4, *truth.shape[1:]), generator=torch.Generator().manual_seed(1))
    measured = (intensities_from_stokes(truth) + DARKEST) * noise
    wrong = measured * measured.new_tensor(WRONG_FACTORS)[:, None, None]
    solved = consistent(wrong[None], load(ROOT).methods.gain)[0]
    unknown, factors = (dolp(stokes_from_intensities(one)) for one in (wrong, solved))
    panels = {"true": dolp(truth), "factors unknown": unknown, "factors solved": factors}
    for axes, (name, degree) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        show_picture(axes, dolp_image(degree))
        rms = float((degree.clamp(0, 1) - panels["true"]).square().mean().sqrt())
        axes.set_title("true DoLP" if name == "true" else f"{name}: RMS error {rms:.3f}", fontsize=9)


def light_figure(figure: Figure) -> None:
    """Draw the sensitivity over light, and the events of each pixel model."""
    sensitivity, events = figure.subplots(1, 2)
    light = np.geomspace(255e-6, 255, 400).astype(np.float32)
    responses: dict[str, dict[str, Any]] = {
        "knee_dn 20, v2e": {}, "knee_dn 2.72": {"knee_dn": 2.72}, "dark_dn 20": {"dark_dn": 20.0},
        "dark_dn 5": {"dark_dn": 5.0}, "dark_dn 0.02": {"dark_dn": 0.02},
    }  # fmt: skip
    for (label, changes), colour in zip(responses.items(), (*LINES, ON), strict=True):
        physics, ends = physics_of(replace(QUIET, **changes)), np.empty((2, len(light)), np.float32)
        for factor, end in zip((0.95, 1.05), ends, strict=True):
            respond(light * np.float32(factor), physics, end)
        sensitivity.semilogx(light, (ends[1] - ends[0]) / math.log(1.05 / 0.95), color=colour, lw=1.4, label=label)
    sensitivity.set(xlabel="light, DN", ylabel="response per ln light", ylim=(0, 3.2))
    sensitivity.legend(fontsize=7, frameon=False, loc="upper left")
    sensitivity.set_title("sensitivity", loc="left", fontsize=9)
    results = json.loads((ROOT / "docs" / "results" / "light.json").read_text())
    for (label, rates), style in zip(results["events"]["per_second"].items(), EVENT_STYLES, strict=True):
        events.semilogx(results["events"]["levels_dn"], rates, linewidth=1.4, label=label, **style)
    events.set(xlabel="brightest light, DN", ylabel="events per second", ylim=(0, 48))
    events.legend(fontsize=6, frameon=False, loc="upper left")
    events.set_title("a swing by e² once a second", loc="left", fontsize=9)


def options_figure(figure: Figure) -> None:
    """Draw the events of the photoreceptor's noise against its deviation, and of a ramp by both refractory periods."""
    noise, ramp = figure.subplots(1, 2)
    deviations, seconds, pixels = np.linspace(0.045, 0.08, 8), 10, 1_000
    t_us = np.arange(seconds * 1000 + 1) * 1000.0
    quiet = replace(QUIET, cutoff_hz=30.0)
    for model, colour, style in (("exact", LINES[1], "-"), ("v2e", LINES[3], "o")):
        noisy = [replace(quiet, model=model, photoreceptor_noise=deviation) for deviation in deviations]
        counts = [len(events_under(np.full(len(t_us), 60.0), t_us, config, pixels)) for config in noisy]
        rates = np.array(counts) / (2 * pixels * seconds)
        noise.semilogy(deviations, rates, style, color=colour, markersize=4, label=model)
    noise.plot(*V2E_NOISE, "x", color=ON, markersize=8, label="v2e's own program")
    noise.set(xlabel="deviation of the noise, ln units", ylabel="events of each sign per second")
    noise.legend(fontsize=8, frameon=False, loc="lower right")
    noise.set_title("photoreceptor noise, 30 Hz, thresholds 0.2", loc="left", fontsize=9)
    t_us = np.arange(0, 6_001, 50.0)
    light = 60 * np.exp(t_us.clip(500, 1_500) / 1000 - 0.5)
    keep = replace(QUIET, refractory_period_us=500.0)
    reset, v2e = replace(keep, refractory="reset"), replace(keep, model="v2e")
    for label, config, colour in (
        ("exact, keep", keep, LINES[1]), ("exact, reset", reset, ON), ("v2e", v2e, LINES[3])
    ):  # fmt: skip
        t_ms = events_under(light, t_us, config).t.numpy() / 1000
        ramp.step(np.r_[0, t_ms, 6], np.r_[0, np.arange(1, len(t_ms) + 1), len(t_ms)], where="post", color=colour,
                  linewidth=1.4, label=label)  # fmt: skip
    ramp.plot(t_us / 1000, np.log(light / 60) / 0.2, label="log light / 0.2", **LINE)
    ramp.set(xlabel="ms", ylabel="events", xlim=(0, 4), ylim=(0, 5.4))
    ramp.legend(fontsize=8, frameon=False, loc="lower right")
    ramp.set_title("refractory period of 0.5 ms", loc="left", fontsize=9)


MOTORCYCLE = next(photo.path for photo in BUILTIN_PHOTOS if photo.path.stem.startswith("motorcycle"))
WINDOW = 24  # of 30; the figure shows its events, and the frames at its end
SEED = 7
MAX_EVENTS = 25_000  # drawn of each channel; above this number, every k-th event is drawn
WIDTHS = 2.3, 2.0, 1.5, 2.2, 2.9
LABEL = "#768390"  # contrast 3.9 on white, 4.8 on a dark page
LIGHT_ON, LIGHT_OFF = "#e5534b", "#4a8ce0"  # visible on white and on a dark page
QUALITY, WIDTH = 80, 1560  # of WebP; twice the width of a page of GitHub
KEY = "hue → AoLP\nsaturation → DoLP\nvalue → S0"


def overview_figure(figure: Figure) -> None:
    """Draw the way of one window, on a transparent background with grey labels for light and dark pages."""
    figure.set_facecolor("none")
    picture = read_rgb(MOTORCYCLE)
    simulation = simulate(picture, MOTIONS["default"], SENSORS["default"], SEED)
    start_us, stop_us = simulation.t_us[WINDOW : WINDOW + 2].tolist()
    intensities, dolp, aolp = (one[WINDOW + 1] for one in (simulation.intensities, simulation.dolp, simulation.aolp))
    recovered = recover(simulation.events, t_us=simulation.t_us).prediction.dolp[WINDOW]
    full, s0 = torch.ones_like(dolp), intensities[::2].sum(0)
    columns = figure.subfigures(1, len(WIDTHS), squeeze=False, width_ratios=WIDTHS)[0]
    events_heading = f"→ events, {(stop_us - start_us) / 1e3:.0f} ms"
    headings = "photograph", "→ polarization", "→ polarizers", events_heading, "→ DoLP"
    for part, heading in zip(columns, headings, strict=True):
        part.set_facecolor("none")
        part.suptitle(heading, color=LABEL, fontsize=13, weight="bold")
    axes = columns[0].subplots()
    show_picture(axes, picture.permute(1, 2, 0).numpy())
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
        show_picture(axes, picture)
        axes.text(0.02, 0.97, label, transform=axes.transAxes, va="top", color="white", fontsize=10, bbox=box)


def _cloud(axes: Axes, events: Events, start_us: int, stop_us: int) -> None:
    """Events in space and time: the sensor seen from the side, time running to the right."""
    step = max(1, -(-len(events) // MAX_EVENTS))
    t, x, y, p = (column.numpy()[::step] for column in (events.t, events.x, events.y, events.p))
    time, across, down = (t - start_us) / (stop_us - start_us), x / events.width, y / events.height
    colours = np.where(p > 0, LIGHT_ON, LIGHT_OFF)
    axes.scatter(0.72 * time + 0.28 * across, 0.28 * across - 0.72 * down, s=0.4, c=colours, alpha=0.6, linewidths=0)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    for moment in (0, 0.72):
        axes.plot(moment + 0.28 * corners[:, 0], 0.28 * corners[:, 0] - 0.72 * corners[:, 1], color=LABEL, lw=0.6)
    axes.axis("off")


def few_colours(content: bytes) -> bytes:
    """Reduce a picture to a palette, as PNG: a third of the bytes, without a visible difference."""
    buffer = io.BytesIO()
    picture = Image.open(io.BytesIO(content)).convert("RGB")
    picture.quantize(PALETTE, dither=Image.Dither.NONE).save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def webp(content: bytes) -> bytes:
    """A PNG as WebP of `WIDTH`: a third of the bytes, with its transparency."""
    picture, buffer = Image.open(io.BytesIO(content)), io.BytesIO()
    picture.thumbnail((WIDTH, WIDTH))
    picture.save(buffer, format="webp", quality=QUALITY, method=6)
    return buffer.getvalue()


def pictures_of_demo() -> dict[str, bytes]:
    """The preview and the last frame of the video that `polarnet demo` writes, as PNG by their files."""
    with tempfile.TemporaryDirectory() as folder:
        if polarnet(["demo", "--out", folder]):
            raise SystemExit("polarnet demo failed")
        with av.open(str(Path(folder, "recovered", "recovered.mp4"))) as video:
            *_, last = video.decode(video=0)
        buffer = io.BytesIO()
        last.to_image().save(buffer, format="png")
        preview = Path(folder, "simulated", "preview.png").read_bytes()
        return {"simulate.png": preview, "recover.png": buffer.getvalue()}


FIGURES: dict[str, tuple[Callable[[Figure], None], float, float]] = {
    "simulation_parameters.png": (parameters_figure, 9.0, 5.2),
    "simulation_crossings.png": (crossings_figure, 9.0, 2.9),
    "theory_gains.png": (gains_figure, 7.2, 2.0),
    "physics_light.png": (light_figure, 9.0, 2.9),
    "physics_options.png": (options_figure, 9.0, 2.7),
    "overview.webp": (overview_figure, 13.0, 4.9),
}
"""Function, width and height of each figure, by its file."""


def main() -> None:
    """Draw all pictures into docs."""
    for name, content in ({name: png(drawn(*figure)) for name, figure in FIGURES.items()} | pictures_of_demo()).items():
        (PICTURES / name).write_bytes(webp(content) if name.endswith("webp") else few_colours(content))


if __name__ == "__main__":
    main()
