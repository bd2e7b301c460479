"""The simulated twin of a recording: the same light through the fitted sensor, and how alike the two are."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64
from scipy.stats import ks_2samp

from polarnet.characterization.fit import SensorFit
from polarnet.characterization.intervals import by_pixel, intervals_of
from polarnet.characterization.light import Flicker, MovingLight
from polarnet.events.stream import Events, concatenate, crop, slice_time
from polarnet.recordings.noise import HOT_FACTOR, event_counts, hot_pixels, without_pixels
from polarnet.runtime.machine import seed_for
from polarnet.simulation.emulator import EmulatorConfig, SensorState, emulate

MAX_SIDE = 240  # pixels of the part that is compared
MAX_DURATION_US = 20_000_000
CHUNK_PIXELS = 1 << 22  # frames times pixels of one piece of simulated light
STATIC_STEP_US = 1_000_000
STEPS_PER_CYCLE = 64
RATE_BINS = 100
INTERVAL_EDGES_US = np.geomspace(50, 1e8, 64)


class Comparison(NamedTuple):
    """Statistics of a recording and of its twin, over the same pixels and the same time."""

    name: str
    height: int
    width: int
    duration_s: float
    hot: int
    """Hot pixels of the recording, which are left out."""
    tick_us: int
    """Step of the recording's clock."""
    time_s: Float64[np.ndarray, " bins"]
    rate_hz: Mapping[str, Float64[np.ndarray, " bins"]]
    """Events per pixel and second, of `recording` and `twin`."""
    ratio: Mapping[str, float]
    """ON events per OFF event."""
    intervals: Mapping[str, Float64[np.ndarray, " edges"]]
    """Share of a pixel's inter-event intervals in each bin of `INTERVAL_EDGES_US`."""
    pixel_rates_hz: Mapping[str, Float64[np.ndarray, " pixels"]]
    interval_distance: float
    """Kolmogorov-Smirnov distance of the intervals: 0 for equal distributions, 1 for disjoint ones."""
    pixel_rate_distance: float

    @property
    def verdict(self) -> str:
        """One line that says how alike the two are."""
        rate = {name: float(values.mean()) for name, values in self.rate_hz.items()}
        return (
            f"Twin to recording: event rate {rate['twin'] / max(rate['recording'], 1e-9):.2f} times, "
            f"ON/OFF {self.ratio['twin']:.2f} against {self.ratio['recording']:.2f}, Kolmogorov-Smirnov distance "
            f"{self.interval_distance:.3f} of the inter-event intervals and {self.pixel_rate_distance:.3f} of the "
            f"pixels' rates (0: equal distributions, 1: disjoint ones)."
        )


def fitted_parameters(fit: SensorFit) -> dict[str, float]:
    """Values for section `emulate` of params.yaml, rounded to four digits: only the estimated ones."""
    return {name: float(f"{one.value:.4g}") for name, one in fit.estimates.items()}


def fitted_sensor(fit: SensorFit, default: EmulatorConfig) -> EmulatorConfig:
    """`default` with the estimated parameters, in continuous time and the same for every sequence."""
    changed: dict[str, Any] = dict(fitted_parameters(fit))
    return replace(default, **changed, model="exact", randomise=None)


def compare(
    name: str, recording: Events, light: MovingLight | Flicker | float, sensor: EmulatorConfig, seed: int
) -> Comparison:
    """Simulate the twin of `recording` under its light (a number is constant light in DN) and compare the two.

    At most the first 20 seconds and the middle 240 x 240 pixels are compared, without the recording's hot pixels; the
    twin has none. ValueError for fewer than two events.
    """
    if len(recording) < 2:
        raise ValueError(f"{name}: expected events to compare, got {len(recording)}; record for longer")
    start_us, stop_us = int(recording.t[0]), int(recording.t[-1])
    if isinstance(light, MovingLight):
        start_us, stop_us = max(start_us, int(light.t_us[0])), min(stop_us, int(light.t_us[-1]))
        if start_us >= stop_us:
            raise ValueError(f"{name}: expected frames at the times of the events; put both on one clock")
    stop_us = min(stop_us, start_us + MAX_DURATION_US)
    duration_s = (stop_us - start_us) * 1e-6
    height, width = min(recording.height, MAX_SIDE), min(recording.width, MAX_SIDE)
    top, left = (recording.height - height) // 2, (recording.width - width) // 2
    part = crop(slice_time(recording, start_us, stop_us), top, left, height, width)
    if isinstance(light, MovingLight):
        within = (light.t_us >= start_us) & (light.t_us <= stop_us)
        light = MovingLight(light.frames[within, top : top + height, left : left + width], light.t_us[within])
    frames, t_us = frames_of(light, start_us, stop_us, height, width)
    twin = emulated(frames, t_us, replace(sensor, hot_pixel_share=0.0), seed_for(seed, "twin", "sensor"))
    hot = hot_pixels(event_counts(part), duration_s, HOT_FACTOR)
    pair = {"recording": without_pixels(part, hot), "twin": without_pixels(twin, hot)}
    intervals_us = {key: intervals_of(by_pixel(events)).duration_us for key, events in pair.items()}
    rates = {key: event_counts(events)[~hot] / duration_s for key, events in pair.items()}
    edges = np.linspace(start_us, stop_us, RATE_BINS + 1)
    per_bin = RATE_BINS / duration_s / max(int((~hot).sum()), 1)
    return Comparison(
        name=name,
        height=height,
        width=width,
        duration_s=duration_s,
        hot=int(hot.sum()),
        tick_us=int(np.gcd.reduce(np.diff(part.t.numpy()))),
        time_s=(0.5 * (edges[1:] + edges[:-1]) - start_us) * 1e-6,
        rate_hz={key: np.histogram(events.t.numpy(), edges)[0] * per_bin for key, events in pair.items()},
        ratio={key: float((e.p > 0).sum()) / max(int((e.p < 0).sum()), 1) for key, e in pair.items()},
        intervals={key: np.histogram(v, INTERVAL_EDGES_US)[0] / max(len(v), 1) for key, v in intervals_us.items()},
        pixel_rates_hz=rates,
        interval_distance=_distance(**intervals_us),
        pixel_rate_distance=_distance(**rates),
    )


def emulated(
    frames: Float32[np.ndarray, "n h w"], t_us: Float64[np.ndarray, " n"], sensor: EmulatorConfig, key: int
) -> Events:
    """Events of one channel under light, in pieces of bounded memory; `frames` may be a view by `frames_of`."""
    state: SensorState | None = None
    parts, step = [], max(2, CHUNK_PIXELS // frames[0].size)
    for k in range(0, len(frames), step):
        some = np.ascontiguousarray(frames[k : k + step])[:, None]
        (events,), state = emulate(some, t_us[k : k + step], sensor, key, state)
        parts.append(events)
    return concatenate(parts)


def frames_of(
    light: MovingLight | Flicker | float | int,
    start_us: float | int,
    stop_us: float | int,
    height: int,
    width: int,
) -> tuple[Float32[np.ndarray, "n h w"], Float64[np.ndarray, " n"]]:
    """Frames of the light on the pixels (of a flicker 64 a cycle), and their times."""
    if isinstance(light, MovingLight):
        return light.frames, light.t_us
    if isinstance(light, Flicker):
        steps = math.ceil((stop_us - start_us) * 1e-6 * light.frequency_hz * STEPS_PER_CYCLE)
        t_us = np.linspace(start_us, stop_us, steps + 1)
        phase = 2e-6 * math.pi * light.frequency_hz * (t_us - start_us)
        values = light.level * (1 + light.contrast * np.sin(phase))
    else:
        t_us = np.append(np.arange(start_us, stop_us, STATIC_STEP_US, dtype=np.float64), stop_us)
        values = np.full(len(t_us), light)
    return np.broadcast_to(values.astype(np.float32)[:, None, None], (len(t_us), height, width)), t_us


def _distance(recording: np.ndarray, twin: np.ndarray) -> float:
    return float(ks_2samp(recording, twin).statistic) if len(recording) and len(twin) else 1.0
