"""Error of the fit to a rotating polarizer's events: python -m studies.rotating [--write]

Still scenes are smooth random maps of S0 from 0.2 to 1, DoLP from 0 to 0.95 and AoLP over half a circle, 60 x 80
pixels, seen by the sensor of params.yaml. Section `rotating` has three such scenes at one turn a second and the window
of params.yaml. The curves change one setting each, on one scene. The fit expects the sensor's mean thresholds and
bandwidth, except in `assumed_threshold`. Moving scenes are compared with the truth at the middle of the window.
`--write` puts the figures into docs/results/camera.json and draws docs/pictures/rotating_polarizer.png.
"""

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure

from polarnet.config.tree import Config, load
from polarnet.methods.rotating_polarizer import ModulationConfig, fit_modulation
from polarnet.pictures.builtin import BUILTIN_PHOTOS
from polarnet.pictures.images import read_rgb
from polarnet.reports.figures import LIGHT, chart_style
from polarnet.simulation.camera import Camera
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.motion import Sine, Trajectory, render
from polarnet.simulation.polarizers import Grid
from polarnet.simulation.presets import SENSORS
from polarnet.simulation.rotating import RotatingConfig, emulate_rotating
from polarnet.simulation.scene import PolarizationScene, scene_from_polarization, scene_from_rgb
from polarnet.stokes import Prediction, aolp, dolp
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "pictures" / "rotating_polarizer.png"
HEIGHT, WIDTH = 60, 80
PHOTOGRAPH = "coffee.png"
MARGIN = 40  # columns beyond the sensor, for motion
GRID = (6, 8)  # independent values of a smooth map
S0_MIN, DOLP_MAX = 0.2, 0.95
HEADLINE_SCENES = (0, 1, 2)
DOLP_BINS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, DOLP_MAX)
S0_BINS = (S0_MIN, 0.4, 0.6, 0.8, 1.0)
HEADROOM = 1.05  # of the axes above the largest value
LONG_PATH_PX = 1e4  # amplitude of a sine whose beginning is an even motion
CURVES = {
    "rate_hz": ("rotation rate, turns/s", (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)),
    "window_turns": ("window, turns", (0.5, 1.0, 2.0, 4.0)),
    "threshold": ("contrast threshold", (0.1, 0.15, 0.2, 0.3, 0.4)),
    "assumed_threshold": ("threshold that the fit expects (true: 0.2)", (0.16, 0.18, 0.2, 0.22, 0.24)),
    "shot_noise_rate_hz": ("shot noise, events/s in the dark", (0.001, 0.1, 1.0, 5.0)),
    "speed_px_s": ("motion, px/s (5 turns/s, window 1 turn)", (0.0, 5.0, 10.0, 20.0, 40.0)),
}
"""Label and values of the setting that each curve changes."""
MOVING_RATE_HZ, MOVING_TURNS = 5.0, 1.0
STILL_RATE_HZ, FRAMES_PER_TURN = 1.0, 720


class Case(NamedTuple):
    """One simulation and fit."""

    scene: PolarizationScene
    rotating: RotatingConfig
    sensor: EmulatorConfig
    modulation: ModulationConfig
    speed_px_s: float = 0.0


class Errors(NamedTuple):
    """Truth and errors of all pixels."""

    s0: np.ndarray
    dolp: np.ndarray
    dolp_error: np.ndarray
    aolp_error_deg: np.ndarray
    expected: np.ndarray
    """Expected error of DoLP."""


def smooth_scene(seed: int) -> PolarizationScene:
    """Bicubic maps through uniformly drawn values, each stretched to its range."""
    generator = np.random.default_rng(seed)

    def smooth() -> torch.Tensor:
        values = torch.from_numpy(generator.random((1, 1, *GRID)))
        image = torch.nn.functional.interpolate(values, (HEIGHT, WIDTH + MARGIN), mode="bicubic")[0, 0]
        return (image - image.min()) / (image.max() - image.min())

    return scene_from_polarization(S0_MIN + (1 - S0_MIN) * smooth(), DOLP_MAX * smooth(), math.pi * smooth())


def photograph() -> PolarizationScene:
    """Centre of a built-in photograph, whose saturation is DoLP."""
    rgb = torch.nn.functional.interpolate(
        read_rgb(next(photo.path for photo in BUILTIN_PHOTOS if photo.file == PHOTOGRAPH))[None],
        scale_factor=0.25,
        mode="area",
    )[0]
    top, left = (rgb.shape[1] - HEIGHT) // 2, (rgb.shape[2] - WIDTH - MARGIN) // 2
    return scene_from_rgb(rgb[:, top : top + HEIGHT, left : left + WIDTH + MARGIN].clamp(0, 1))


def errors_of(case: Case) -> Errors:
    """Simulate one window of turns and fit it."""
    stop_us = round(case.modulation.window_turns / abs(case.rotating.rate_hz) * 1e6)
    trajectory = moving_right(case.speed_px_s)
    camera, pixels = Camera(case.sensor, key=1), Grid(HEIGHT, WIDTH)
    events = emulate_rotating(case.rotating, camera, case.scene, trajectory, stop_us, pixels)
    prediction, _ = fit_modulation(events, case.rotating.rotation, 0, stop_us, case.modulation)
    (stokes,) = render(case.scene, trajectory, np.array([stop_us * 0.5e-6]), HEIGHT, WIDTH)
    return errors_against(stokes, prediction)


def moving_right(speed_px_s: float) -> Trajectory:
    """Even motion from the left edge."""
    still = Sine(0.0, 0.0, 0.0)
    path = Sine(LONG_PATH_PX, speed_px_s / LONG_PATH_PX, 0.0)
    return Trajectory((WIDTH - 1) / 2, (HEIGHT - 1) / 2, (path,), (still,), still, still, speed_px_s)


def errors_against(stokes: torch.Tensor, prediction: Prediction) -> Errors:
    """Errors of a prediction of DoLP, AoLP and log variance."""
    assert prediction.aolp is not None
    assert prediction.log_variance is not None
    truth, angle = dolp(stokes).double(), aolp(stokes).double()
    turned = torch.remainder(prediction.aolp - angle + math.pi / 2, math.pi) - math.pi / 2
    maps = stokes[0], truth, prediction.dolp - truth, torch.rad2deg(turned), torch.exp(prediction.log_variance / 2)
    return Errors(*(one.double().numpy().ravel() for one in maps))


def scores(errors: Errors) -> dict[str, float]:
    """Root of the mean squared error of DoLP, mean AoLP error weighted by DoLP, and the quality of expected errors."""
    ratio = np.abs(errors.dolp_error) / errors.expected
    return {
        "dolp_rms": _rms(errors.dolp_error),
        "dolp_bias": round(float(errors.dolp_error.mean()), 4),
        "aolp_deg": round(float(np.average(np.abs(errors.aolp_error_deg), weights=errors.dolp)), 3),
        "expected_rms": _rms(errors.expected),
        "within_expected": round(float((ratio <= 1).mean()), 3),
        "within_twice_expected": round(float((ratio <= 2).mean()), 3),
    }


def binned(errors: Errors, values: np.ndarray, edges: tuple[float, ...]) -> list[dict[str, float]]:
    """Scores by the truth's DoLP or S0."""
    rows = []
    for low, high in itertools.pairwise(edges):
        chosen = (values >= low) & ((values < high) | (high == edges[-1]))
        part = Errors(*(one[chosen] for one in errors))
        rows.append({"low": low, "high": high, "pixels": int(chosen.sum()), **scores(part)})
    return rows


def _rms(values: np.ndarray) -> float:
    return round(float(np.sqrt(np.mean(values**2))), 4)


def still_case(config: Config, scene: PolarizationScene) -> Case:
    """A scene at rest, with the sensor and the fit of params.yaml."""
    rotating = replace(config.rotating, rate_hz=STILL_RATE_HZ, frames_per_turn=FRAMES_PER_TURN)
    return Case(scene, rotating, config.emulate, config.modulation)


def case_of(config: Config, curve: str, value: float) -> Case:
    """The case of a curve's point."""
    case = still_case(config, smooth_scene(0))
    if curve == "rate_hz":
        return case._replace(rotating=replace(case.rotating, rate_hz=value))
    if curve == "window_turns":
        return case._replace(modulation=replace(case.modulation, window_turns=value))
    if curve == "threshold":
        spread = config.modulation.threshold_spread * value
        sensor: Any = {"contrast_threshold_on": value, "contrast_threshold_off": value}
        sensor |= {"contrast_threshold_sigma_on": spread, "contrast_threshold_sigma_off": spread}
        modulation = replace(case.modulation, threshold_on=value, threshold_off=value)
        return case._replace(sensor=replace(case.sensor, **sensor), modulation=modulation)
    if curve == "assumed_threshold":
        return case._replace(modulation=replace(case.modulation, threshold_on=value, threshold_off=value))
    if curve == "shot_noise_rate_hz":
        return case._replace(sensor=replace(case.sensor, shot_noise_rate_hz=value))
    rotating = replace(case.rotating, rate_hz=MOVING_RATE_HZ)
    modulation = replace(case.modulation, window_turns=MOVING_TURNS)
    return case._replace(rotating=rotating, modulation=modulation, speed_px_s=value)


def single_cases(config: Config) -> dict[str, Case]:
    """Cases apart from the curves."""
    still = still_case(config, smooth_scene(0))
    noisy = SENSORS["noisy"]
    spread = noisy.contrast_threshold_sigma_on / noisy.contrast_threshold_on
    prior_config = replace(config.modulation, cutoff_hz=noisy.cutoff_hz, threshold_spread=spread)
    return {
        "photograph": still._replace(scene=photograph()),
        "sensor clean": still._replace(sensor=SENSORS["clean"], modulation=replace(config.modulation, cutoff_hz=0.0)),
        "sensor noisy": still._replace(sensor=noisy, modulation=prior_config),
        "bandwidth unknown (fit without lag)": still._replace(modulation=replace(config.modulation, cutoff_hz=0.0)),
        "extinction 100:1, known": still._replace(
            rotating=replace(still.rotating, extinction_ratio=100.0),
            modulation=replace(config.modulation, extinction_ratio=100.0),
        ),
    }


def measure(config: Config) -> tuple[dict[str, Any], dict[str, Any]]:
    """Section `rotating`, and the curves and cases."""
    scenes = [still_case(config, smooth_scene(seed)) for seed in HEADLINE_SCENES]
    errors = Errors(*map(np.concatenate, zip(*map(errors_of, scenes), strict=True)))
    figures: dict[str, Any] = {
        **scores(errors),
        "rate_hz": STILL_RATE_HZ,
        "window_turns": config.modulation.window_turns,
    }
    figures |= {"scenes": len(scenes)}
    figures |= {"by_dolp": binned(errors, errors.dolp, DOLP_BINS), "by_s0": binned(errors, errors.s0, S0_BINS)}
    print(json.dumps(figures, indent=1), flush=True)
    curves: dict[str, Any] = {}
    for curve, (_, values) in CURVES.items():
        curves[curve] = [{"value": value, **scores(errors_of(case_of(config, curve, value)))} for value in values]
        print(curve, *(f"{one['value']:g}: {one['dolp_rms']:.4f}/{one['aolp_deg']:.2f}" for one in curves[curve]))
    cases = {name: scores(errors_of(case)) for name, case in single_cases(config).items()}
    print(json.dumps(cases, indent=1))
    return figures | {"cases": cases}, curves


def curves_figure(curves: Mapping[str, list[Mapping[str, float]]]) -> Figure:
    """RMS error of DoLP (left axes) and AoLP error (right axes) by each setting."""
    with matplotlib.rc_context(chart_style(LIGHT)):
        figure = Figure(figsize=(10, 5.4), layout="constrained", facecolor="white")
        for axes, (curve, (label, _)) in zip(figure.subplots(2, 3).ravel(), CURVES.items(), strict=True):
            x = [point["value"] for point in curves[curve]]
            axes.plot(x, [point["dolp_rms"] for point in curves[curve]], "o-", color="#1f6feb")
            axes.plot(x, [point["expected_rms"] for point in curves[curve]], ":", color="#1f6feb")
            axes.set_xlabel(label)
            axes.set_ylabel("DoLP error, RMS (dotted: expected)", color="#1f6feb")
            if curve in ("rate_hz", "shot_noise_rate_hz"):
                axes.set_xscale("log")
            right = axes.twinx()
            right.plot(x, [point["aolp_deg"] for point in curves[curve]], "s--", color="#c2410c")
            right.set_ylabel("AoLP error, degrees", color="#c2410c")
            for side in (axes, right):
                side.set_ylim(0, HEADROOM * side.get_ylim()[1])
    return figure


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/camera.json and the picture")
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    torch.set_num_threads(1)
    figures, curves = measure(load(ROOT))
    if arguments.write:
        path = write_section(ROOT, "camera", "rotating", figures | {"curves": curves}, record)
        curves_figure(curves).savefig(PICTURE, dpi=110)
        print(f"written to {path.relative_to(ROOT)} and {PICTURE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
