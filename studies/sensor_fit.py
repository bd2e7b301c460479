"""Accuracy of `polarnet fit-sensor` on simulated sensors: python -m studies.sensor_fit [--seed N] [--write]

Each sensor is drawn from RANGES and recorded by the pixel model `exact`: under constant light, before drifting dead
leaves whose light is rendered 1000 times a second, and before lamps that flicker. The fit gets the events and, for the
leaves, 8-bit frames at --frame-rate. It knows nothing of the sensor. Two fits are made: `frames` (static, leaves) and
`flicker` (static, lamps). `--write` puts the figures into docs/results/camera.json, sections `sensor_fit` and
`sensor_fit_flicker`.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from polarnet.characterization.fit import SensorFit, fit_sensor
from polarnet.characterization.known_light import KnownLight
from polarnet.characterization.light import Flicker, MovingLight
from polarnet.characterization.twin import constant_frames, emulated, flicker_light
from polarnet.events.stream import Events
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.runtime.machine import generator_for
from polarnet.simulation.camera import Camera
from polarnet.simulation.emulator import EmulatorConfig
from polarnet.simulation.pixels.light import FULL_SCALE
from polarnet.simulation.presets import SENSORS
from studies.measure import arguments_of, command_line, machine_record, write_section

ROOT = Path(__file__).resolve().parents[1]
HEIGHT, WIDTH = 60, 80
RANGES = {
    "contrast_threshold_on": (0.08, 0.42),
    "contrast_threshold_off": (0.08, 0.42),
    "contrast_threshold_sigma_on": (0.02, 0.06),
    "contrast_threshold_sigma_off": (0.02, 0.06),
    "contrast_threshold_correlation": (-0.3, 0.3),
    "cutoff_hz": (30.0, 300.0),
    "leak_rate_hz": (0.01, 0.3),
    "shot_noise_rate_hz": (0.05, 5.0),
    "refractory_period_us": (100.0, 1000.0),
    "hot_pixel_share": (0.001, 0.01),
    "hot_pixel_rate_hz": (30.0, 300.0),
}
"""Sensors are drawn uniformly, rates in their logarithm."""
MAX_RELATIVE_SIGMA = 0.3  # of the threshold
STATIC_S, STATIC_LIGHT = 300, 200.0
MOVING_S, RENDER_HZ, SPEED_PX_S = 10.0, 1000, 60.0
LEAVES_MARGIN = 80  # pixels that the leaves extend beyond the sensor
LEAVES_BLUR = 1.0  # pixels, standard deviation of a lens's blur
DARKEST_LEAF = 0.04
FLICKERS = {2.0: 4.0, 20.0: 1.0, 60.0: 0.5}
"""Seconds recorded at each frequency (Hz)."""
CONTRAST, FLICKER_LIGHT = 0.8, 100.0
SECTIONS = {"frames": "sensor_fit", "flicker": "sensor_fit_flicker"}
ERRORS = {
    "threshold_error_max": ("contrast_threshold_on", "contrast_threshold_off"),
    "deviation_error_max": ("threshold_deviation_on", "threshold_deviation_off"),
    "noise_error_max": ("leak_rate_hz", "shot_noise_rate_hz"),
    "bandwidth_error_max": ("cutoff_hz",),
    "hot_rate_error_max": ("hot_pixel_rate_hz",),
}
"""Relative errors."""
REPORTED = (
    *(name for names in ERRORS.values() for name in names),
    "refractory_period_us",
    "threshold_correlation",
    "hot_pixel_share",
)
PARAMETERS = {
    "threshold_deviation_on": "contrast_threshold_sigma_on",
    "threshold_deviation_off": "contrast_threshold_sigma_off",
    "threshold_correlation": "contrast_threshold_correlation",
}
"""Parameters of the emulator whose names differ from those in the results."""


def drawn_sensor(number: int, seed: int) -> EmulatorConfig:
    """Sensor `number` of the draws of `seed`."""
    ranges: dict[str, list[float | str]] = {name: list(bounds) for name, bounds in RANGES.items()}
    camera = Camera(replace(SENSORS["default"], model="exact", randomise=ranges))
    sensor = camera.drawn(seed, f"sensor {number}").sensor
    sigmas = {
        f"contrast_threshold_sigma_{polarity}": min(
            getattr(sensor, f"contrast_threshold_sigma_{polarity}"),
            MAX_RELATIVE_SIGMA * getattr(sensor, f"contrast_threshold_{polarity}"),
        )
        for polarity in ("on", "off")
    }
    return replace(sensor, **sigmas)


def static_recording(sensor: EmulatorConfig, key: int) -> Events:
    """Five minutes of constant light."""
    t_us = np.arange(0, STATIC_S + 1, 5) * 1e6
    return emulated(constant_frames(np.full(len(t_us), STATIC_LIGHT), HEIGHT, WIDTH), t_us, sensor, key)


def drifting_leaves(
    height: int, width: int, t_us: Float64[np.ndarray, " n"], speed_px_s: float, generator: np.random.Generator
) -> Float32[np.ndarray, "n h w"]:
    """Light of dead leaves that drift along a slow Lissajous figure, DN."""
    size = height + 2 * LEAVES_MARGIN, width + 2 * LEAVES_MARGIN
    scene = cv2.GaussianBlur(dead_leaves(generator, *size).mean(axis=2), (0, 0), LEAVES_BLUR)
    scene = (FULL_SCALE * np.clip(scene, DARKEST_LEAF, 1)).astype(np.float32)
    reach = 0.75 * LEAVES_MARGIN
    angle = t_us * 1e-6 * speed_px_s / reach
    left = LEAVES_MARGIN + reach * np.sin(angle)
    top = LEAVES_MARGIN + reach * np.sin(0.77 * angle + 1)
    moves = (np.array([[1, 0, -x], [0, 1, -y]]) for x, y in zip(left, top, strict=True))
    return np.stack([np.asarray(cv2.warpAffine(scene, move, (width, height))) for move in moves])


def leaves(sensor: EmulatorConfig, key: int, frame_rate_hz: int) -> KnownLight:
    """Drifting dead leaves, and the 8-bit frames of them that the fit gets."""
    t_us = np.arange(round(MOVING_S * RENDER_HZ) + 1) * (1e6 / RENDER_HZ)
    light = drifting_leaves(HEIGHT, WIDTH, t_us, SPEED_PX_S, generator_for(1, "leaves", "fit"))
    step = RENDER_HZ // frame_rate_hz
    events = emulated(iter([light]), t_us, sensor, key)
    return KnownLight("moving", events, MovingLight(np.rint(light[::step]), t_us[::step]))


def lamps(sensor: EmulatorConfig, key: int) -> list[KnownLight]:
    """Flickering lamps of unknown phase."""
    known = []
    for frequency_hz, seconds in FLICKERS.items():
        flicker = Flicker(FLICKER_LIGHT, CONTRAST, frequency_hz)
        t_us, values = flicker_light(flicker, 0.0, seconds * 1e6)
        events = emulated(constant_frames(values, HEIGHT, WIDTH), t_us, sensor, key)
        known.append(KnownLight(f"flicker {frequency_hz:g} Hz", events, flicker))
    return known


def errors_of(fits: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Largest relative errors over the sensors, and how many values were not estimated."""
    headlines: dict[str, Any] = {}
    for key, names in ERRORS.items():
        errors = [
            abs(fit["estimate"][name] / fit["truth"][name] - 1)
            for fit in fits
            for name in names
            if fit["estimate"][name] is not None
        ]
        headlines[key] = round(max(errors), 4) if errors else None
    headlines["not_estimated"] = {
        name: missing for name in REPORTED if (missing := sum(fit["estimate"][name] is None for fit in fits))
    }
    return headlines


def row_of(sensor: EmulatorConfig, fit: SensorFit) -> dict[str, Any]:
    """Truth and estimates of a sensor."""
    parameters = {name: PARAMETERS.get(name, name) for name in REPORTED}
    truth = {name: round(getattr(sensor, of), 5) for name, of in parameters.items()}
    estimate = {name: fit.estimates[of].value if of in fit.estimates else None for name, of in parameters.items()}
    return {"truth": truth, "estimate": {name: value and round(value, 5) for name, value in estimate.items()}}


def fitted(number: int, seed: int, kind: str, frame_rate_hz: int) -> dict[str, Any]:
    """Simulate and fit sensor `number`; prints its row."""
    sensor, key = drawn_sensor(number, seed), 1000 * seed + number
    known = [leaves(sensor, key, frame_rate_hz)] if kind == "frames" else lamps(sensor, key)
    row = row_of(sensor, fit_sensor(static_recording(sensor, key), STATIC_LIGHT, known))
    print(number, kind, json.dumps(row), flush=True)
    return row


def main() -> None:
    """The command line."""
    parser = command_line(__doc__, "docs/results/camera.json")
    parser.add_argument("--sensors", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1, help="seed of the drawn sensors; 1: the documented ones")
    parser.add_argument("--frame-rate", type=int, default=100, help="frames per second that the fit gets")
    parser.add_argument("--light", nargs="+", choices=("frames", "flicker"), default=["frames", "flicker"])
    arguments = arguments_of(parser)
    record = machine_record(ROOT)
    for kind in arguments.light:
        rows = [fitted(number, arguments.seed, kind, arguments.frame_rate) for number in range(arguments.sensors)]
        settings: dict[str, Any] = {
            "seed": arguments.seed,
            "height": HEIGHT,
            "width": WIDTH,
            "static_s": STATIC_S,
            "static_light_dn": STATIC_LIGHT,
        }
        if kind == "frames":
            settings |= {"moving_s": MOVING_S, "frame_rate_hz": arguments.frame_rate, "speed_px_s": SPEED_PX_S}
        else:
            settings |= {"flicker_s": {f"{hz:g} Hz": s for hz, s in FLICKERS.items()}, "contrast": CONTRAST}
        section = {**errors_of(rows), **settings, "sensors": rows}
        print(SECTIONS[kind], json.dumps({key: value for key, value in section.items() if key != "sensors"}))
        if arguments.write:
            path = write_section(ROOT, "camera", SECTIONS[kind], section, record)
            print(f"written to {path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
