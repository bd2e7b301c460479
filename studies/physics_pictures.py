"""The pictures of docs/physics.md and docs/theory-*.md: python -m studies.physics_pictures [FOLDER]

Every point, line and event in them comes from the simulation itself; where a formula is drawn, its label says so.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from polarnet.config.tree import load
from polarnet.events.mosaic import places_of
from polarnet.methods.intensities import consistent
from polarnet.reports.figures import LIGHT, show_picture
from polarnet.reports.maps import dolp_image, intensity_image
from polarnet.simulation.camera import PERFECT, Camera, PolarizersConfig, read_out, weights_of
from polarnet.simulation.emulator import EmulatorConfig, emulate
from polarnet.simulation.motion import Pose, Sine, Trajectory, frame_times_us, render_poses
from polarnet.simulation.moving_sensor import channel_light, emulate_motion
from polarnet.simulation.pixels.light import KNEE, respond
from polarnet.simulation.pixels.physics import physics_of
from polarnet.simulation.presets import MOTIONS, POLARIZERS, SENSORS
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization
from polarnet.stokes import (
    POLARIZER_ANGLES_DEG,
    dolp,
    intensities_from_stokes,
    intensity_behind_polarizer,
    parse_mosaic,
    stokes_from_intensities,
    stokes_from_polarization,
)
from studies.overview import OFF, ON
from studies.simulation_pictures import LINE, QUIET, drawn, events_under, photograph, write_pictures
from studies.study import ROOT

COLOURS = ("#1c2330", "#2f7fc1", "#3f9c6d", "#e08a1e")
DEGREES, AOLP_DEG = (0.2, 0.6, 1.0), 30.0  # of the light behind a turning polarizer
WRONG_FACTORS = (1.0, 0.7, 1.4, 1.1)  # of the intensities behind 0, 45, 90 and 135 degrees
NOISE = 0.02  # relative standard deviation of the intensities
DARKEST = 0.004  # of white; added behind every polarizer, as stray light
STILL = Sine(0.0, 0.0, 0.0)
SWING = Trajectory(300.0, 200.0, (Sine(60.0, 8.0, 0.0),), (Sine(30.0, 5.0, 1.0),), STILL, STILL, 630.0)
PALETTE = 256  # colours of a picture on disk
CONSTANT_SPEED_PX_S = 97.3
FLAT_HEIGHT, FLAT_WIDTH = 40, 200
SETTLING_FRAMES = 6  # until each pixel has fired, and its memory is that of an endless motion
SIZE = (200, 300)  # rows and columns of the sensor behind the presets
EVENT_STYLES: tuple[dict[str, Any], ...] = (
    {"color": COLOURS[0]}, {"color": COLOURS[2]}, {"color": COLOURS[3]}, {"color": ON},
    {"color": COLOURS[1], "linestyle": "--"}, {"color": LIGHT.quiet, "linestyle": ":"},
    {"color": LIGHT.quiet, "linestyle": "-."},
)  # fmt: skip
V2E_NOISE = (0.0551, 0.211)  # deviation, and events of each sign per second in two runs (tests of the emulator's noise)
LIGHTS_DN = (0, 15, 30, 60, 90, 120, 150, 180, 210, 240, 255)


@drawn(9.0, 5.4)
def pixel_figure(figure: Figure) -> None:
    """Draw a pixel's physics, from its light to its events."""
    draws = (_draw_response, _draw_photoreceptor, _draw_mismatch, _draw_noise, _draw_refractory, _draw_bit_depth)
    for axes, draw in zip(figure.subplots(2, 3).ravel(), draws, strict=True):
        draw(axes)


def _draw_response(axes: Axes) -> None:
    light, response = np.arange(256, dtype=np.float32), np.empty(256, np.float32)
    respond(light, physics_of(QUIET), response)
    axes.plot(light, response, **LINE)
    axes.axvline(KNEE, color=LIGHT.grid, linewidth=1, zorder=0)
    axes.annotate("logarithm", (90, float(response[90])), (95, 3.6), color=LIGHT.quiet, fontsize=8)
    axes.annotate("linear below 20 DN", (KNEE, 0.4), (28, 0.4), color=LIGHT.quiet, fontsize=8)
    axes.set(xlabel="light, DN", ylabel="response, ln units", xlim=(0, 255), ylim=(0, None))
    axes.set_title("light to response", loc="left", fontsize=9)


def _draw_photoreceptor(axes: Axes) -> None:
    """The sum of the events of a pixel with small thresholds follows the filtered response."""
    config = replace(QUIET, cutoff_hz=60.0, contrast_threshold_on=0.01, contrast_threshold_off=0.01)
    t_us = np.arange(0, 60_001, 100.0)
    for light_dn, colour in zip((200.0, 60.0, 15.0), COLOURS, strict=False):
        light = np.where(t_us < 5_000, light_dn / 1.25, light_dn)
        ends = np.empty(2, np.float32)
        respond(np.array([light_dn / 1.25, light_dn], np.float32), physics_of(QUIET), ends)
        events = events_under(light, t_us, config)
        t_ms, rise = events.t.numpy() / 1000, events.p.numpy().cumsum() * 0.01 / float(ends[1] - ends[0])
        axes.step(np.r_[0, t_ms, 60], np.r_[0, rise, rise[-1:]], where="post", color=colour, linewidth=1.2)
        axes.text(58, 1.12 - 0.12 * (200.0, 60.0, 15.0).index(light_dn) - 0.45, f"{light_dn:g} DN", color=colour,
                  ha="right", fontsize=8)  # fmt: skip
    axes.set(xlabel="ms", ylabel="share of a step", xlim=(0, 60), ylim=(0, 1.05))
    axes.set_title("photoreceptor, 60 Hz: slow in the dark", loc="left", fontsize=9)


def _draw_mismatch(axes: Axes) -> None:
    """The first event on a ramp of log light comes when the ramp has reached the pixel's threshold."""
    config = SENSORS["default"]
    quiet = replace(config, cutoff_hz=0.0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0, refractory_period_us=0.0)
    t_us = np.arange(0, 1_000_001, 5_000.0)
    for sign, colour, label in ((1, ON, "ON"), (-1, OFF, "OFF")):
        events = events_under(80 * np.exp(sign * 0.35 * t_us / 1e6), t_us, quiet, pixels=20_000)
        first = np.full(20_000, np.nan)
        x, t = events.x.numpy()[::-1], events.t.numpy()[::-1]
        first[x] = t
        counts, edges = np.histogram(0.35 * first / 1e6, np.arange(0.08, 0.34, 0.008))
        axes.stairs(counts, edges, color=colour, linewidth=1.3, label=label)
    axes.legend(fontsize=8, frameon=False)
    axes.set(xlabel="threshold of a pixel, ln units", ylabel="pixels of 20,000")
    axes.set_title("mismatch of the default sensor", loc="left", fontsize=9)


def _draw_noise(axes: Axes) -> None:
    """Events in constant light, against its brightness."""
    seconds, pixels = 20, 500
    t_us = np.array([0.0, seconds * 1e6])
    shot, leak = replace(QUIET, shot_noise_rate_hz=5.0), replace(QUIET, leak_rate_hz=1.0)
    for label, config, sign, colour, marker in (
        ("shot noise, ON", shot, 1, ON, "^"), ("shot noise, OFF", shot, -1, OFF, "v"),
        ("leak, ON", leak, 1, COLOURS[3], "o"),
    ):  # fmt: skip
        fired = [events_under(np.full(2, float(light)), t_us, config, pixels).p == sign for light in LIGHTS_DN]
        rates = [float(one.sum()) / pixels / seconds for one in fired]
        axes.plot(LIGHTS_DN, rates, marker, color=colour, markersize=4, label=label)
    light = np.linspace(0, 255, 50)
    axes.plot(light, 2.5 * (1 - 0.75 * (light + 20) / 275), color=LIGHT.quiet, linewidth=1, label="v2e's formula")
    axes.legend(fontsize=7, frameon=False)
    axes.set(xlabel="light, DN", ylabel="events per second", ylim=(0, 3.3))
    axes.set_title("shot noise 5 Hz, leak 1 Hz", loc="left", fontsize=9)


def _draw_refractory(axes: Axes) -> None:
    """After a step of light by a factor of e, a pixel fires five events of 0.2, each after its blind time."""
    t_us = np.arange(0, 40_001, 100.0)
    light = np.where(t_us < 2_000, 40.0, 40 * np.exp(1) * 1.01)
    for period_ms, colour in zip((0.0, 2.0, 7.0), COLOURS, strict=False):
        events = events_under(light, t_us, replace(QUIET, refractory_period_us=1000 * period_ms))
        t_ms = events.t.numpy() / 1000
        axes.step(np.r_[0, t_ms, 40], np.r_[0, np.arange(1, len(t_ms) + 1), len(t_ms)], where="post", color=colour,
                  linewidth=1.4, label=f"{period_ms:g} ms")  # fmt: skip
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    axes.set(xlabel="ms", ylabel="events", xlim=(0, 40), ylim=(0, 5.6))
    axes.set_title("refractory period, after a step of light", loc="left", fontsize=9)


def _draw_bit_depth(axes: Axes) -> None:
    """A slow ramp from 10 to 40 DN, as floating-point light and rounded to 8 bits."""
    t_us = np.arange(0, 2_000_001, 2_000.0)
    light = 10 * np.exp(np.log(4) * t_us / 2e6)
    config = replace(QUIET, contrast_threshold_on=0.05, contrast_threshold_off=0.05)
    for row, (eight_bit, label) in enumerate(((False, "floating-point light"), (True, "rounded to 8 bits"))):
        events = events_under(light, t_us, config, eight_bit=eight_bit)
        axes.vlines(events.t.numpy() / 1e6, 1.5 * row + 0.1, 1.5 * row + 0.9, color=ON, linewidth=0.8)
        moments = len(np.unique(events.t.numpy() // 2_000))
        axes.text(0, 1.5 * row + 0.95, f"{label}: {len(events)} events at {moments} times", fontsize=8,
                  color=LIGHT.quiet, va="bottom")  # fmt: skip
    axes.set_yticks([])
    axes.set(xlabel="s", ylim=(-0.1, 2.9), xlim=(-0.02, 2.02))
    axes.grid(visible=False)
    axes.set_title("ramp from 10 to 40 DN, threshold 0.05", loc="left", fontsize=9)


@drawn(9.0, 2.7)
def polarizers_figure(figure: Figure) -> None:
    """Draw Malus' law for each preset, and a picture through the mosaic of a DoFP sensor."""
    curves, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.0, 1.05))[0]
    for part in (curves, right):
        part.set_facecolor(LIGHT.face)
    axes = curves.subplots()
    angles = np.radians(np.linspace(-90, 90, 361))
    for (name, polarizers), colour in zip(POLARIZERS.items(), COLOURS, strict=True):
        weights = weights_of(replace(polarizers, angle_error_deg=[0.0] * 4), 1, 1, 0)[0].astype(np.float64)
        through = weights @ np.stack([np.ones_like(angles), np.cos(2 * angles), np.sin(2 * angles)])
        axes.semilogy(np.degrees(angles), through.clip(1e-6), color=colour, linewidth=1.4,
                      label=name.replace("_", " "))  # fmt: skip
    axes.set(xlabel="angle between light and axis, degrees", ylabel="transmission", ylim=(1e-4, 1.5), xlim=(-90, 90))
    axes.set_xticks(range(-90, 91, 45))
    axes.legend(fontsize=8, frameon=False, loc="lower center")
    axes.set_title("fully polarized light, without crosstalk", loc="left", fontsize=9)
    _draw_mosaic(right, POLARIZERS["micropolarizers"])


def _draw_mosaic(figure: Any, polarizers: PolarizersConfig) -> None:
    """A part of a photograph as the pixels of a DoFP sensor see it, and its four channels."""
    channels = channels_of(photograph(), polarizers)[:, 20:52, 30:62]
    raw = np.empty((64, 64))
    for channel, (row, column) in zip(channels, places_of(parse_mosaic(polarizers.mosaic)), strict=True):
        raw[row::2, column::2] = channel
    grid = figure.add_gridspec(2, 4)
    whole = figure.add_subplot(grid[:, :2])
    show_picture(whole, intensity_image(torch.from_numpy(raw / raw.max()).float()), LIGHT)
    whole.set_title("DoFP sensor", loc="left", fontsize=9)
    for number, (channel, angle) in enumerate(zip(channels, POLARIZER_ANGLES_DEG, strict=True)):
        axes = figure.add_subplot(grid[number // 2, 2 + number % 2])
        show_picture(axes, intensity_image(torch.from_numpy(channel / raw.max()).float()), LIGHT)
        axes.set_title(f"{angle}°", loc="left", fontsize=9)


def channels_of(scene: PolarizationScene, polarizers: PolarizersConfig) -> Float64[np.ndarray, "4 h2 w2"]:
    """Light of the four channels, in [0, 1], of a still sensor in the middle of the scene."""
    middle = Pose(*(np.array([value]) for value in ((scene.width - 1) / 2, (scene.height - 1) / 2, 0.0, 1.0)))
    light = render_poses(scene, middle, *SIZE).transpose(1, 0, 2, 3)
    return channel_light(light, polarizers, weights_of(polarizers, *SIZE, key=1))[:, 0].astype(np.float64) / 255


@drawn(9.0, 2.8)
def readout_figure(figure: Figure) -> None:
    """Draw the times of a flash by row, and a bus whose limit the events exceed."""
    rows, rate, waits = figure.subplots(1, 3)
    t_us = torch.tensor([0.0, 5_000.0, 5_001.0, 30_000.0], dtype=torch.float64)
    card = torch.tensor([50.0, 50.0, 75.0, 75.0])[:, None, None, None].expand(-1, 1, 60, 80).contiguous()
    (flash,), _ = emulate(card, t_us, QUIET, key=1)  # a grey card becomes brighter at 5 ms
    for readout, colour, label in (
        (PERFECT, LIGHT.quiet, "perfect"),
        (replace(PERFECT, row_latency_us=20.0), COLOURS[1], "20 µs a row"),
        (replace(PERFECT, max_events_per_s=1e6, max_wait_us=1500.0), ON, "1 Mev/s, wait 1.5 ms"),
    ):
        events, _ = read_out(flash, readout, key=1, duration_us=30_000)
        rows.plot(events.t.numpy() / 1000, events.y.numpy(), ".", color=colour, markersize=1.2, label=label)
    rows.set(xlabel="ms", ylabel="row", xlim=(4.8, 8.0), ylim=(60, 0))
    rows.legend(fontsize=7, frameon=False, markerscale=6, loc="lower right")
    rows.set_title("a flash on 60 rows", loc="left", fontsize=9)
    swing = emulate_motion(Camera(SENSORS["default"], key=1), photograph(), SWING, 1_000_000, (60, 80))[0]
    limit_hz = 1e5
    limited, lost = read_out(
        swing, replace(PERFECT, max_events_per_s=limit_hz, max_wait_us=5_000.0), key=1, duration_us=1_000_000
    )
    for events, colour, label in ((swing, LIGHT.quiet, "of the pixels"), (limited, ON, "read out")):
        counts = np.bincount(events.t.numpy() // 5_000, minlength=200)[:200]
        rate.step(np.arange(200) * 5e-3, counts * 200 / 1000, where="post", color=colour, linewidth=1.2, label=label)
    rate.set(xlabel="s", ylabel="kev/s", xlim=(0, 1), ylim=(0, None))
    rate.legend(fontsize=7, frameon=False)
    rate.set_title(f"limit {limit_hz / 1000:g} kev/s: {lost / len(swing):.0%} lost", loc="left", fontsize=9)
    offered = np.linspace(0.1, 2.5, 25)
    for wait_us, colour in zip((200.0, 5_000.0), (COLOURS[1], COLOURS[3]), strict=True):
        shares = [
            read_out(swing, replace(PERFECT, max_events_per_s=len(swing) / load, max_wait_us=wait_us), key=1,
                     duration_us=1_000_000)[1] / len(swing) for load in offered
        ]  # fmt: skip
        waits.plot(offered, shares, color=colour, linewidth=1.4, label=f"wait up to {wait_us / 1000:g} ms")
    waits.plot(offered, np.maximum(0, 1 - 1 / offered), color=LIGHT.quiet, linewidth=1, label="steady rate: 1 - 1/load")
    waits.set(xlabel="mean rate / limit", ylabel="events lost", ylim=(0, None))
    waits.legend(fontsize=7, frameon=False)
    waits.set_title("loss against load", loc="left", fontsize=9)


def periodic_scene(columns: int) -> PolarizationScene:
    """Unpolarized light whose pattern repeats after `FLAT_WIDTH` columns: the sensor always sees all of it."""
    generator = np.random.default_rng(0)
    pattern = generator.standard_normal((FLAT_HEIGHT + 2, FLAT_WIDTH))
    smooth = np.exp(-((np.arange(FLAT_WIDTH // 2 + 1) / 25) ** 2))
    pattern = np.fft.irfft(np.fft.rfft(pattern, axis=1) * smooth, FLAT_WIDTH, axis=1)
    s0 = (0.4 * np.exp(0.5 * pattern / pattern.std())).clip(0, 1)
    plane = torch.from_numpy(np.tile(s0, (1, columns // FLAT_WIDTH + 1))).float()
    return scene_from_polarization(plane, torch.zeros_like(plane), torch.zeros_like(plane))


def events_per_frame(config: EmulatorConfig, speed_px_s: float, duration_s: float = 2.0) -> Int64[np.ndarray, " n"]:
    """Events of successive frames of a sensor that drifts at constant speed, after the first `SETTLING_FRAMES`.

    It moves by less than the pattern's period, after which all pixels would cross their first level at once.
    """
    assert speed_px_s * duration_s < FLAT_WIDTH
    far = 1e6  # amplitude of a sine whose start is a straight line
    line = Sine(far, speed_px_s / far, 0.0)
    path = Trajectory(FLAT_WIDTH / 2 + 1, (FLAT_HEIGHT + 1) / 2, (line,), (STILL,), STILL, STILL, speed_px_s)
    edges_us = frame_times_us(replace(MOTIONS["default"], duration_s=duration_s))
    scene = periodic_scene(int(speed_px_s * duration_s) + FLAT_WIDTH + 8)
    events = emulate_motion(Camera(config, key=1), scene, path, int(edges_us[-1]), (FLAT_HEIGHT, FLAT_WIDTH))[0]
    return np.diff(np.searchsorted(events.t.numpy(), edges_us))[SETTLING_FRAMES:]


@drawn(9.0, 2.6)
def rate_figure(figure: Figure) -> None:
    """Draw events per frame at constant speed over a pattern that repeats."""
    settings: Mapping[str, tuple[str, float | None]] = {
        "exact, a frame of light for each pixel of motion": ("exact", None),
        "exact, 300 frames of light a second": ("exact", 300.0),
        "v2e, 300 frames of light a second": ("v2e", 300.0),
        "v2e, a frame of light for each pixel of motion": ("v2e", None),
    }
    axes = figure.subplots()
    for (label, (model, rate_hz)), colour in zip(settings.items(), COLOURS, strict=True):
        counts = events_per_frame(replace(QUIET, model=model, render_rate_hz=rate_hz), CONSTANT_SPEED_PX_S)
        spread = counts.std() / counts.mean()
        axes.plot(counts / counts.mean(), ".-", color=colour, linewidth=1, markersize=4,
                  label=f"{label}: {spread:.1%} RMS")  # fmt: skip
    axes.legend(fontsize=7, frameon=False, ncols=2, loc="upper center")
    axes.set(xlabel="frame (30 a second)", ylabel="events / mean", ylim=(0.75, 1.4))
    axes.set_title(f"{CONSTANT_SPEED_PX_S:g} px/s over a pattern", loc="left", fontsize=9)


@drawn(6.4, 3.0)
def malus_figure(figure: Figure) -> None:
    """Draw intensity behind a polarizer against its angle, with the four measured angles marked."""
    axes = figure.subplots()
    for degree, colour in zip(DEGREES, (*COLOURS[:2], COLOURS[3]), strict=True):
        axes.plot(range(181), [_behind(degree, angle) for angle in range(181)], color=colour, label=f"DoLP {degree:g}")
        marked = [_behind(degree, angle) for angle in POLARIZER_ANGLES_DEG]
        axes.plot(POLARIZER_ANGLES_DEG, marked, "o", color=colour)
    axes.axvline(AOLP_DEG, color=LIGHT.quiet, linestyle=":", label=f"AoLP {AOLP_DEG:g}°")
    axes.set(xlabel="angle of the polarizer, degrees", ylabel="intensity / S0", xticks=range(0, 181, 45))
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def _behind(degree: float, angle_deg: float) -> float:
    plane = torch.ones(1, 1, dtype=torch.float64)
    stokes = stokes_from_polarization(plane, degree * plane, math.radians(AOLP_DEG) * plane)
    return float(intensity_behind_polarizer(stokes, math.radians(angle_deg)))


@drawn(7.2, 2.0)
def gains_figure(figure: Figure) -> None:
    """Draw true DoLP, DoLP with wrong factors of the polarizers, and DoLP with factors from the redundancy."""
    scene = photograph()
    top, left = (scene.height - SIZE[0]) // 2, (scene.width - SIZE[1]) // 2
    truth = scene.stokes[:, top : top + SIZE[0], left : left + SIZE[1]].double()
    noise = 1 + NOISE * torch.randn((4, *truth.shape[1:]), generator=torch.Generator().manual_seed(1))
    measured = (intensities_from_stokes(truth) + DARKEST) * noise
    wrong = measured * measured.new_tensor(WRONG_FACTORS)[:, None, None]
    solved = consistent(wrong[None], load(ROOT).methods.gain)[0]
    panels = {"true": dolp(truth), "factors unknown": _dolp_of(wrong), "factors solved": _dolp_of(solved)}
    for axes, (name, degree) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        show_picture(axes, dolp_image(degree), LIGHT)
        rms = float((degree.clamp(0, 1) - panels["true"]).square().mean().sqrt())
        axes.set_title("true DoLP" if name == "true" else f"{name}: RMS error {rms:.3f}", fontsize=9)


def _dolp_of(intensities: Float64[Tensor, "4 h w"]) -> Float64[Tensor, "h w"]:
    return dolp(stokes_from_intensities(intensities))


@drawn(9.0, 2.9)
def light_figure(figure: Figure) -> None:
    """Draw the sensitivity over light, and the events of each pixel model."""
    sensitivity, events = figure.subplots(1, 2)
    light = np.geomspace(255e-6, 255, 400).astype(np.float32)
    responses: dict[str, dict[str, Any]] = {
        "knee_dn 20, v2e": {}, "knee_dn 2.72": {"knee_dn": 2.72}, "dark_dn 20": {"dark_dn": 20.0},
        "dark_dn 5": {"dark_dn": 5.0}, "dark_dn 0.02": {"dark_dn": 0.02},
    }  # fmt: skip
    for (label, changes), colour in zip(responses.items(), (*COLOURS, ON), strict=True):
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


@drawn(9.0, 2.7)
def options_figure(figure: Figure) -> None:
    """Draw the events of the photoreceptor's noise against its deviation, and of a ramp by both refractory periods."""
    noise, ramp = figure.subplots(1, 2)
    deviations, seconds, pixels = np.linspace(0.045, 0.08, 8), 10, 1_000
    t_us = np.arange(seconds * 1000 + 1) * 1000.0
    quiet = replace(QUIET, cutoff_hz=30.0)
    for model, colour, style in (("exact", COLOURS[1], "-"), ("v2e", COLOURS[3], "o")):
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
        ("exact, keep", keep, COLOURS[1]), ("exact, reset", reset, ON), ("v2e", v2e, COLOURS[3])
    ):  # fmt: skip
        t_ms = events_under(light, t_us, config).t.numpy() / 1000
        ramp.step(np.r_[0, t_ms, 6], np.r_[0, np.arange(1, len(t_ms) + 1), len(t_ms)], where="post", color=colour,
                  linewidth=1.4, label=label)  # fmt: skip
    ramp.plot(t_us / 1000, np.log(light / 60) / 0.2, label="log light / 0.2", **LINE)
    ramp.set(xlabel="ms", ylabel="events", xlim=(0, 4), ylim=(0, 5.4))
    ramp.legend(fontsize=8, frameon=False, loc="lower right")
    ramp.set_title("refractory period of 0.5 ms", loc="left", fontsize=9)


FIGURES = {
    "theory_malus": malus_figure,
    "theory_gains": gains_figure,
    "physics_pixel": pixel_figure,
    "physics_polarizers": polarizers_figure,
    "physics_readout": readout_figure,
    "physics_rate": rate_figure,
    "physics_light": light_figure,
    "physics_options": options_figure,
}


if __name__ == "__main__":
    write_pictures(FIGURES, "Draw the pictures of docs/physics.md and docs/theory-*.md.", PALETTE)
