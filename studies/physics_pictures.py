"""The pictures of docs/physics.md and docs/theory-*.md: python -m studies.physics_pictures [FOLDER]

Every point, line and event in them comes from the simulation itself; where a formula is drawn, its label says so.
"""

import functools
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from polarnet.config.tree import load
from polarnet.methods.intensities import consistent
from polarnet.reports.figures import LIGHT, show_picture
from polarnet.reports.maps import dolp_image
from polarnet.simulation.pixels.light import respond
from polarnet.simulation.pixels.physics import physics_of
from polarnet.stokes import dolp, intensities_from_stokes, stokes_from_intensities
from studies.simulation_pictures import LINE, ON, QUIET, drawn, events_under, few_colours, photograph, write_pictures
from studies.study import ROOT

COLOURS = ("#1c2330", "#2f7fc1", "#3f9c6d", "#e08a1e")
WRONG_FACTORS = (1.0, 0.7, 1.4, 1.1)  # of the intensities behind 0, 45, 90 and 135 degrees
NOISE = 0.02  # relative standard deviation of the intensities
DARKEST = 0.004  # of white; added behind every polarizer, as stray light
PALETTE = 256  # colours of a picture on disk
SIZE = (200, 300)  # rows and columns of the sensor behind the presets
EVENT_STYLES: tuple[dict[str, Any], ...] = (
    {"color": COLOURS[0]}, {"color": COLOURS[2]}, {"color": COLOURS[3]}, {"color": ON},
    {"color": COLOURS[1], "linestyle": "--"}, {"color": LIGHT.quiet, "linestyle": ":"},
    {"color": LIGHT.quiet, "linestyle": "-."},
)  # fmt: skip
V2E_NOISE = (0.0551, 0.211)  # deviation, and events of each sign per second in two runs (tests of the emulator's noise)


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
    unknown, factors = (dolp(stokes_from_intensities(one)) for one in (wrong, solved))
    panels = {"true": dolp(truth), "factors unknown": unknown, "factors solved": factors}
    for axes, (name, degree) in zip(figure.subplots(1, 3), panels.items(), strict=True):
        show_picture(axes, dolp_image(degree), LIGHT)
        rms = float((degree.clamp(0, 1) - panels["true"]).square().mean().sqrt())
        axes.set_title("true DoLP" if name == "true" else f"{name}: RMS error {rms:.3f}", fontsize=9)


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
    "theory_gains": gains_figure,
    "physics_light": light_figure,
    "physics_options": options_figure,
}


if __name__ == "__main__":
    write_pictures(
        FIGURES,
        "Draw the pictures of docs/physics.md and docs/theory-*.md.",
        functools.partial(few_colours, colours=PALETTE),
    )
