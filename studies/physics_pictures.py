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
from studies.simulation_pictures import ON, QUIET, drawn, few_colours, photograph, write_pictures
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


FIGURES = {
    "theory_gains": gains_figure,
    "physics_light": light_figure,
}


if __name__ == "__main__":
    write_pictures(
        FIGURES,
        "Draw the pictures of docs/physics.md and docs/theory-*.md.",
        functools.partial(few_colours, colours=PALETTE),
    )
