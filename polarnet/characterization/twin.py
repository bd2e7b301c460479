"""The simulated twin of a recording: the same light through the fitted sensor, and how alike the two are."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64
from scipy.stats import ks_2samp

from polarnet.characterization.fit import SensorFit
from polarnet.characterization.flicker import Flicker
from polarnet.characterization.intervals import by_pixel, intervals_of
from polarnet.events.stream import Events, concatenate, crop, slice_time
from polarnet.recordings.noise import event_counts, hot_pixels, without_pixels
from polarnet.runtime.machine import seed_for
from polarnet.simulation.emulator import EmulatorConfig, SensorState, emulate
from polarnet.terminal.progress import ProgressBar

MAX_SIDE = 240  # pixels of the part that is compared
MAX_DURATION_US = 20_000_000
CHUNK_PIXELS = 1 << 22  # frames times pixels of one piece of simulated light
STATIC_STEP_US = 1_000_000
STEPS_PER_CYCLE = 64


class Comparison(NamedTuple):
    """Statistics of a recording and of its twin, over the same pixels and the same time."""

    rate: float
    """Events of the twin per event of the recording."""
    ratio: float
    """ON events per OFF event of the recording."""
    twin_ratio: float
    interval_distance: float
    """Kolmogorov-Smirnov distance of inter-event intervals: 0 for equal distributions, 1 for disjoint ones."""
    pixel_rate_distance: float
    """The same of the pixels' numbers of events."""

    @property
    def verdict(self) -> str:
        """One line that says how alike the two are."""
        return (
            f"Twin to recording: event rate {self.rate:.2f} times, ON/OFF {self.twin_ratio:.2f} against "
            f"{self.ratio:.2f}, Kolmogorov-Smirnov distance {self.interval_distance:.3f} of the inter-event intervals "
            f"and {self.pixel_rate_distance:.3f} of the pixels' rates (0: equal distributions, 1: disjoint ones)."
        )


def fitted_parameters(fit: SensorFit) -> dict[str, float]:
    """Values for section `emulate` of params.yaml, rounded to four digits: only the estimated ones."""
    return {name: float(f"{one.value:.4g}") for name, one in fit.estimates.items()}


def fitted_sensor(fit: SensorFit, default: EmulatorConfig) -> EmulatorConfig:
    """`default` with the estimated parameters, in continuous time and the same for every sequence."""
    changed: dict[str, Any] = dict(fitted_parameters(fit))
    return replace(default, **changed, model="exact", randomise=None)


def compare(recording: Events, light: Flicker | float, sensor: EmulatorConfig, seed: int) -> Comparison:
    """Simulate the twin of `recording` under its light (a number is constant light in DN) and compare the two.

    At most the first 20 seconds and the middle 240 x 240 pixels are compared, without the recording's hot pixels; the
    twin has none. ValueError for fewer than two events.
    """
    if len(recording) < 2:
        raise ValueError(f"expected events to compare, got {len(recording)}; record for longer")
    start_us = int(recording.t[0])
    stop_us = min(int(recording.t[-1]), start_us + MAX_DURATION_US)
    height, width = min(recording.height, MAX_SIDE), min(recording.width, MAX_SIDE)
    top, left = (recording.height - height) // 2, (recording.width - width) // 2
    part = crop(slice_time(recording, start_us, stop_us), top, left, height, width)
    frames, t_us = frames_of(light, start_us, stop_us, height, width)
    twin = emulated(frames, t_us, replace(sensor, hot_pixel_share=0.0), seed_for(seed, "twin", "sensor"))
    hot = hot_pixels(event_counts(part), (stop_us - start_us) * 1e-6)
    pair = [without_pixels(part, hot), without_pixels(twin, hot)]
    ratios = [float((events.p > 0).sum()) / max(int((events.p < 0).sum()), 1) for events in pair]
    return Comparison(
        len(pair[1]) / max(len(pair[0]), 1),
        ratios[0],
        ratios[1],
        _distance(*(intervals_of(by_pixel(events)).duration_us for events in pair)),
        _distance(*(event_counts(events)[~hot] for events in pair)),
    )


def emulated(
    frames: Float32[np.ndarray, "n h w"], t_us: Float64[np.ndarray, " n"], sensor: EmulatorConfig, key: int
) -> Events:
    """Events of one channel under light, in pieces of bounded memory; `frames` may be a view by `frames_of`."""
    state: SensorState | None = None
    parts, step = [], max(2, CHUNK_PIXELS // frames[0].size)
    for k in ProgressBar(range(0, len(frames), step), "twin", unit="piece"):
        some = np.ascontiguousarray(frames[k : k + step])[:, None]
        (events,), state = emulate(some, t_us[k : k + step], sensor, key, state)
        parts.append(events)
    return concatenate(parts)


def frames_of(
    light: Flicker | float | int, start_us: float | int, stop_us: float | int, height: int, width: int
) -> tuple[Float32[np.ndarray, "n h w"], Float64[np.ndarray, " n"]]:
    """Frames of the light on the pixels (of a flicker 64 a cycle), and their times."""
    if isinstance(light, Flicker):
        steps = math.ceil((stop_us - start_us) * 1e-6 * light.frequency_hz * STEPS_PER_CYCLE)
        t_us = np.linspace(start_us, stop_us, steps + 1)
        values = light.light(2e-6 * math.pi * light.frequency_hz * (t_us - start_us))
    else:
        t_us = np.append(np.arange(start_us, stop_us, STATIC_STEP_US, dtype=np.float64), stop_us)
        values = np.full(len(t_us), light)
    return np.broadcast_to(values.astype(np.float32)[:, None, None], (len(t_us), height, width)), t_us


def _distance(recording: np.ndarray, twin: np.ndarray) -> float:
    return float(ks_2samp(recording, twin).statistic) if len(recording) and len(twin) else 1.0
