"""Response of the simulated camera to dim light: python -m studies.light [--write]

Events: pixels see a swing of light by a factor of e^2 once a second, at levels over six decades, with each pixel model
and response. DoLP: the shipped network sees generated scenes (dead leaves) that are dimmed, through the default sensor
with v2e's response and with dark currents of 0, 5 and 20 DN. `--write` puts the figures into docs/results/light.json.
"""

import argparse
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.recovery import recover
from polarnet.runtime.machine import generator_for, tune
from polarnet.simulation.emulator import EmulatorConfig, emulate
from polarnet.simulation.presets import MOTIONS, SENSORS
from polarnet.simulation.scene import PolarizationScene, scene_from_rgb
from polarnet.simulation.sequence import simulate
from studies.pictures import QUIET
from studies.study import command_line, measure_sections

RESPONSES: dict[str, dict[str, Any]] = {
    "exact, v2e's response": {"model": "exact"},
    "exact, dark_dn 20": {"model": "exact", "dark_dn": 20.0},
    "exact, dark_dn 5": {"model": "exact", "dark_dn": 5.0},
    "exact, dark_dn 0.02": {"model": "exact", "dark_dn": 0.02},
    "v2e": {"model": "v2e"},
    "esim": {"model": "esim"},
    "dvs_voltmeter": {"model": "dvs_voltmeter"},
}
"""Pixel models and responses of the figure; others of v2e equal those of exact."""
LEVELS_DN = np.geomspace(255e-6, 255, 37)  # brightest light of a swing
SWING = math.e**2  # brightest over darkest light of a swing
SECONDS, RATE_HZ = 4, 300.0
DARK_DN = (None, 0.0, 5.0, 20.0)
DIMMED = (1.0, 0.3, 0.1, 0.03, 0.01, 0.001)  # factors on the light of a scene
SCENES, HEIGHT, WIDTH, WARMUP = 4, 240, 320, 5  # warm-up in windows, as in the benchmark


def events_by_light(config: EmulatorConfig) -> list[float]:
    """Events per second of a pixel without mismatch or noise, at each of `LEVELS_DN`."""
    t_us = np.rint(np.arange(SECONDS * RATE_HZ + 1) * 1e6 / RATE_HZ)
    swing = SWING ** ((np.cos(2 * math.pi * t_us / 1e6) - 1) / 2)
    frames = (swing[:, None] * LEVELS_DN).astype(np.float32).reshape(len(t_us), 1, 1, -1)
    (events,), _ = emulate(frames, t_us, config, key=1)
    counts = np.bincount(events.x.numpy()[events.t.numpy() > 1e6], minlength=len(LEVELS_DN))
    return (counts / (SECONDS - 1)).round(3).tolist()


def dolp_error(dark_dn: float | None, dimmed: float) -> float:
    """Mean squared DoLP error of the shipped network on the dimmed scenes, after the warm-up."""
    sensor, errors = replace(SENSORS["default"], dark_dn=dark_dn), []
    for number in range(SCENES):
        rgb = dead_leaves(generator_for(1, f"light-{number}", "picture"), HEIGHT, WIDTH)
        scene = scene_from_rgb(torch.from_numpy(rgb).permute(2, 0, 1))
        simulation = simulate(PolarizationScene(scene.stokes * dimmed), MOTIONS["default"], sensor, seed=number)
        predicted = recover(simulation.events, t_us=simulation.t_us).prediction.dolp
        errors.append(float(((predicted - simulation.dolp[1:]) ** 2)[WARMUP:].mean()))
    return round(float(np.mean(errors)), 5)


def measure_events(_: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Events a second by pixel model and response, and levels of light."""
    events = {label: events_by_light(replace(QUIET, **changes)) for label, changes in RESPONSES.items()}
    return {"levels_dn": LEVELS_DN.tolist(), "per_second": events}, {}


def measure_dolp(_: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """DoLP error by dark current and light."""
    tune()
    mse = {str(dark): {str(dimmed): dolp_error(dark, dimmed) for dimmed in DIMMED} for dark in DARK_DN}
    return {"scenes": SCENES, "mse": mse}, {}


if __name__ == "__main__":
    sections = {"events": ("light", "events", measure_events), "dolp": ("light", "dolp", measure_dolp)}
    measure_sections(command_line(__doc__, "docs/results/light.json"), sections)
