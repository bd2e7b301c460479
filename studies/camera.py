"""How true the simulated camera is, and how it sees dim light: python -m studies.camera [--only NAME ...] [--write]

- defects: the test of each defect that an audit found is run, and a DoFP sensor is calibrated from its own events.
  --write: docs/results/camera.json.
- events: pixels see a swing of light by a factor of e^2 once a second, at levels over six decades, with each pixel
  model and response. --write: docs/results/light.json.
- dolp: the shipped network sees generated scenes (dead leaves) that are dimmed, through the default sensor with v2e's
  response and with dark currents of 0, 5 and 20 DN. --write: docs/results/light.json.
"""

import argparse
import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from polarnet.clips.video import simulate_video
from polarnet.config.tree import load
from polarnet.events.rotation import Rotation
from polarnet.events.stream import select
from polarnet.methods.rotating_polarizer import fit_half_turn
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.recovery import recover
from polarnet.runtime.machine import generator_for, tune
from polarnet.simulation.camera import Camera, pixel_analyzers
from polarnet.simulation.emulator import EmulatorConfig, emulate
from polarnet.simulation.pixels.light import FULL_SCALE, KNEE
from polarnet.simulation.presets import MOTIONS, POLARIZERS, SENSORS
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, scene_from_rgb
from polarnet.simulation.sequence import simulate
from studies.pictures import QUIET
from studies.study import ROOT, command_line, measure_sections, outcomes

SIZE = (12, 16)  # rows and columns of the calibrated sensor
STEP = 0.01  # contrast thresholds of its pixels, natural-log intensity
LAMP_DOLP = 0.6  # keeps the light behind every pixel above the knee of the response
LINEAR_RESPONSE = 2.5  # the response is proportional to light up to ln 20 = 3.0
ABOVE_KNEE = 1 / 3  # share of its light from which the lamp is above the knee behind every polarizer
FINE = replace(QUIET, contrast_threshold_on=STEP, contrast_threshold_off=STEP)
HALF_TURN_US, FRAMES = 4_000_000, 360
DEFECTS = (
    "pictures/test_polarimetry.py::test_numbers_that_count_frames_are_no_angles",
    "pictures/test_polarimetry.py::test_bits_that_are_0_below_those_of_the_camera_do_not_raise_its_white",
    "simulation/test_truth.py::test_a_cell_is_valid_unless_its_truth_or_light_changes_with_masked_pixels",
    "simulation/test_video.py::test_texture_of_polarization_alone_moves_too",
    "simulation/test_motion.py::test_a_bar_at_30_degrees_polarized_along_itself_stays_so_while_the_camera_rolls",
    "simulation/test_rotating_light.py"
    "::test_light_is_rendered_as_often_as_the_polarizer_the_sensor_and_the_motion_need",
    "simulation/test_rotating_light.py::test_v2e_sees_eight_bits_of_the_light",
    "test_stokes.py::test_dolp_of_nan_is_nan",
    "simulation/test_sensor_polarizers.py::test_keys_count_modulo_2_to_the_64",
    "simulation/test_sensor_polarizers.py::test_a_spread_at_full_transmission_lowers_its_mean_as_stated",
)
"""The test of each defect, below tests/."""
FROM_V2E = ("default", "clean", "noisy", "random")
"""Sensors of conf/sensor that are no real camera's."""
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
SECONDS, RATE_HZ = 4, 300.0  # of the swings
DARK_DN = (None, 0.0, 5.0, 20.0)
DIMMED = (1.0, 0.3, 0.1, 0.03, 0.01, 0.001)  # factors on the light of a scene
SCENES, HEIGHT, WIDTH, WARMUP = 4, 240, 320, 5  # dimmed scenes; warm-up in windows, as in the benchmark


def lamp(s0: float, degree: float, angle: float) -> PolarizationScene:
    """Light that is the same all over the sensor."""
    return scene_from_polarization(*(torch.full(SIZE, value) for value in (s0, degree, angle % math.pi)))


def calibrated_analyzers(camera: Camera, seed: int) -> Float64[Tensor, "4 3 h w"]:
    """Analyzer of every pixel of a DoFP sensor, from the events of two recordings of a uniform lamp.

    First the lamp is unpolarized and rises from dark to white, then falls. Above the knee, the light at a pixel's
    events gives its thresholds; below, where the response is proportional to light, its a0. Then the lamp's
    polarization turns: `fit_half_turn` gives (a1, a2) / a0.
    """
    rate_hz = 0.5e6 / HALF_TURN_US
    base = replace(load(ROOT).methods.rotating_polarizer, cutoff_hz=camera.sensor.cutoff_hz, ridge=1e-9)
    t_us = np.linspace(0, 2 * HALF_TURN_US, 2 * FRAMES + 1).round().astype(int).tolist()
    swelling = [lamp(min(k, 2 * FRAMES - k) / FRAMES, 0.0, 0.0) for k in range(2 * FRAMES + 1)]
    turning = [lamp(1.0, LAMP_DOLP, math.pi * t / HALF_TURN_US) for t in t_us[: FRAMES + 1]]
    rotation = Rotation(np.array([0.0, 1.0]) / rate_hz * 1e6, np.array([0.0, 2 * math.pi]))
    swollen = simulate_video(swelling, t_us, camera, seed).events
    turned = simulate_video(turning, t_us[: FRAMES + 1], camera, seed).events
    analyzers = torch.zeros(len(turned), 3, SIZE[0] // 2, SIZE[1] // 2, dtype=torch.float64)
    for channel, (row, column) in itertools.product(range(len(turned)), np.ndindex(SIZE[0] // 2, SIZE[1] // 2)):
        of_channel = swollen[channel], turned[channel]
        lit, turns = (select(events, (events.y == row) & (events.x == column)) for events in of_channel)
        t, rises = lit.t.numpy(), lit.p.numpy() > 0
        shares = 1 - np.abs(t / HALF_TURN_US - 1)  # of the lamp's light
        on, off = (
            abs(math.log(bright[-1] / bright[0])) / (len(bright) - 1)
            for bright in (shares[side & (shares > ABOVE_KNEE)] for side in (rises, ~rises))
        )
        dim = shares[rises][: int(LINEAR_RESPONSE / on)]
        a0 = on * (len(dim) - 1) / (dim[-1] - dim[0]) * KNEE / math.log(KNEE) / FULL_SCALE
        assert a0 * ABOVE_KNEE * FULL_SCALE > KNEE
        config = replace(base, threshold_on=on, threshold_off=off, level_dn=a0 * FULL_SCALE)
        degree, angle, _ = (one[row, column].item() for one in fit_half_turn(turns, rotation, HALF_TURN_US, config))
        polarized = a0 * degree / LAMP_DOLP
        analyzer = [a0, polarized * math.cos(2 * angle), polarized * math.sin(2 * angle)]
        analyzers[channel, :, row, column] = torch.tensor(analyzer)
    return analyzers


def analyzer_errors(sensor: EmulatorConfig, seed: int = 1) -> Float64[Tensor, "4 3 h w"]:
    """Errors of calibrated analyzers, relative to the a0 of their pixels, for the preset of micropolarizers."""
    camera = Camera(sensor, POLARIZERS["micropolarizers"])
    true = pixel_analyzers(camera.drawn(seed, "video"), *SIZE).double()
    return (calibrated_analyzers(camera, seed) - true) / true[:, :1]


def measure_defects(_: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Defects whose tests pass; their number, that of presets of real cameras, and errors of calibrated analyzers."""
    cases = outcomes(*(f"tests/{test}" for test in DEFECTS))
    mended = {
        test: min(one["passed"] for case, one in cases.items() if case.partition("[")[0] == test.partition("::")[2])
        for test in DEFECTS
    }
    exact, noisy = (analyzer_errors(sensor) for sensor in (FINE, SENSORS["default"]))
    cameras = [path for path in (ROOT / "conf" / "sensor").glob("*.yaml") if path.stem not in FROM_V2E]
    return mended, {
        "defects_mended": sum(mended.values()),
        "sensor_presets": len(cameras),
        "analyzer_error_max": round(float(exact.abs().max()), 5),
        "analyzer_error_default_sensor": {
            "max": round(float(noisy.abs().max()), 4),
            "rms": round(float(noisy.square().mean().sqrt()), 4),
        },
    }


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
    sections = {
        "defects": ("camera", "defects", measure_defects),
        "events": ("light", "events", measure_events),
        "dolp": ("light", "dolp", measure_dolp),
    }
    measure_sections(command_line(__doc__, "docs/results/camera.json and light.json"), sections)
