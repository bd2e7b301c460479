"""A sinusoidal flicker on all pixels of a camera, and its change between two events of a pixel.

Light is in digital numbers (DN): 0 is dark, 255 white.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import minimize_scalar

from polarnet.characterization.intervals import Intervals, PixelEvents, chosen_pixels, intervals_of, undisturbed
from polarnet.events.stream import Events
from polarnet.simulation.pixels.light import FULL_SCALE, respond_as_v2e
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION, PixelConfig, physics_of

STEPS_PER_CYCLE = 256  # linear pieces of a cycle: 3e-4 of the contrast off at most
PHASES = 32
PHASE_INTERVALS = 6000  # intervals that the phase is fitted to
BLOCK = 8  # consecutive intervals; even blocks make one half of the data, odd blocks the other


@dataclass(frozen=True)
class Flicker:
    """The same light on all pixels: level (1 + contrast sin(2 pi frequency t + phase))."""

    level: float
    """Mean, DN."""
    contrast: float
    """(brightest - darkest) / (brightest + darkest)"""
    frequency_hz: float

    def __post_init__(self):
        if not 0 < self.contrast < 1:
            raise ValueError(f"contrast: expected (max - min) / (max + min) between 0 and 1, got {self.contrast}")
        if not self.frequency_hz > 0:
            raise ValueError(f"frequency: expected Hz above 0, got {self.frequency_hz}")
        if not 0 < self.level <= FULL_SCALE / (1 + self.contrast):
            raise ValueError(
                f"flicker light: expected a mean above 0 DN whose maximum, mean x (1 + contrast), is at most "
                f"{FULL_SCALE:g} DN, got {self.level} DN at contrast {self.contrast}; lower the mean"
            )

    def light(self, phase: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """DN at phases in radians."""
        return self.level * (1 + self.contrast * np.sin(phase))


@dataclass(frozen=True)
class FlickerRecording:
    """A recording under a flicker whose phase is not known."""

    name: str
    events: Events
    flicker: Flicker


def flicker_cycle(flicker: Flicker, pixel: PixelConfig, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
    """Response of `pixel` behind a photoreceptor of bandwidth `cutoff_hz` (0: infinite) over one settled cycle.

    It has `STEPS_PER_CYCLE` steps from phase 0 to 2 pi inclusive. As in `pixels.exact`, the response to the light is
    linear within a step, and the bandwidth is that at the step's mean light.
    """
    light = flicker.light(np.linspace(0, 2 * math.pi, STEPS_PER_CYCLE + 1))
    rounded = np.empty(len(light), np.float32)
    respond_as_v2e(light.astype(np.float32), physics_of(pixel), rounded)
    response = rounded.astype(np.float64)
    if cutoff_hz == 0:
        return response
    bandwidth_hz = cutoff_hz * (0.5 * (light[1:] + light[:-1]) + DARK_OFFSET) / SATURATION
    per_step = 2 * math.pi * bandwidth_hz / (flicker.frequency_hz * STEPS_PER_CYCLE)
    decay = np.exp(-per_step)
    steps = np.stack([decay, -np.diff(response) * (1 - decay) / per_step], axis=1).tolist()

    def lags(first: float) -> list[float]:
        """Filtered response less the response at each step, from the first one on."""
        return list(itertools.accumulate(steps, lambda lag, step: lag * step[0] + step[1], initial=first))

    return response + lags(lags(0.0)[-1] / (1 - float(decay.prod())))  # a settled cycle ends where it begins


def flicker_responses(
    cycle: Float64[np.ndarray, " k"], frequency_hz: float, phase: float, t_us: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Filtered response at the times of events, from `flicker_cycle`, for a flicker of `phase` at time 0."""
    turns = (t_us * (1e-6 * frequency_hz) + phase / (2 * math.pi)) % 1.0
    return np.interp(turns, np.linspace(0, 1, len(cycle)), cycle)


class Source(NamedTuple):
    """Intervals of a recording under a flicker, and the filtered response at its events for a bandwidth."""

    name: str
    events: PixelEvents
    intervals: Intervals
    responses: Callable[[PixelEvents, float], Float64[np.ndarray, " n"]]


class Increments(NamedTuple):
    """Changes of the filtered log light between two events of a pixel, times the polarity of the second event."""

    increment: Float64[np.ndarray, " n"]
    duration_s: Float64[np.ndarray, " n"]
    pixel: Int64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]
    block: Int64[np.ndarray, " n"]


def source_of(recording: FlickerRecording, events: PixelEvents, pixel: PixelConfig, refractory_us: float) -> Source:
    """The intervals of a recording that the refractory period does not disturb; `events` are those of `recording`."""
    intervals = undisturbed(intervals_of(events), refractory_us)
    flicker = exact_frequency(recording.flicker, events)

    @functools.cache
    def cycle_and_phase(cutoff_hz: float) -> tuple[Float64[np.ndarray, " k"], float]:
        cycle = flicker_cycle(flicker, pixel, cutoff_hz)
        return cycle, flicker_phase(cycle, flicker.frequency_hz, events, intervals)

    def responses(some: PixelEvents, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
        cycle, phase = cycle_and_phase(cutoff_hz)
        return flicker_responses(cycle, flicker.frequency_hz, phase, some.t_us)

    return Source(recording.name, events, intervals, responses)


def increments_of(sources: Sequence[Source], cutoff_hz: float) -> Increments:
    """Increments of all sources, for a photoreceptor of bandwidth `cutoff_hz` at full brightness (0: infinite)."""
    parts = []
    for source in sources:
        response, intervals = source.responses(source.events, cutoff_hz), source.intervals
        increment = np.where(intervals.on, 1.0, -1.0) * (response[intervals.stop] - response[intervals.start])
        block = np.arange(len(increment)) // BLOCK
        parts.append((increment, intervals.duration_us * 1e-6, intervals.pixel, intervals.on, block))
    return Increments(*map(np.concatenate, zip(*parts, strict=True)))


def at_pixels(source: Source, mask: Bool[np.ndarray, " pixels"]) -> Source:
    """The part of a source at some pixels."""
    selected = mask[source.events.pixel]
    number = np.cumsum(selected) - 1
    chosen = mask[source.intervals.pixel]
    start, stop = number[source.intervals.start[chosen]], number[source.intervals.stop[chosen]]
    rest = (column[chosen] for column in source.intervals[2:])
    return source._replace(events=chosen_pixels(source.events, mask), intervals=Intervals(start, stop, *rest))


def exact_frequency(flicker: Flicker, events: PixelEvents) -> Flicker:
    """The flicker with its frequency on the recording's clock, from the drift of the phase of its events."""
    t_s, sign = events.t_us * 1e-6, np.where(events.on, 1.0, -1.0)
    middle = 0.5 * (t_s.min() + t_s.max())
    frequency = flicker.frequency_hz
    for parts in (8, 2):
        edges = np.linspace(t_s.min(), t_s.max(), parts + 1)
        phase = 2 * math.pi * frequency * (t_s - middle)
        real, imaginary = (np.histogram(t_s, edges, weights=sign * wave(phase))[0] for wave in (np.cos, np.sin))
        phasors = real - 1j * imaginary
        turn = np.angle((phasors[1:] * phasors[:-1].conj()).sum())
        frequency += turn / (2 * math.pi * (edges[1] - edges[0]))
    return replace(flicker, frequency_hz=float(frequency))


def flicker_phase(
    cycle: Float64[np.ndarray, " k"], frequency_hz: float, events: PixelEvents, intervals: Intervals
) -> float:
    """Phase of the flicker at time 0, radians, which makes the increments of each polarity most nearly equal."""
    step = max(1, len(intervals.start) // PHASE_INTERVALS)
    start_us, stop_us = events.t_us[intervals.start[::step]], events.t_us[intervals.stop[::step]]
    on = intervals.on[::step]

    def unequal(phase: float) -> float:
        rise = flicker_responses(cycle, frequency_hz, phase, stop_us)
        rise -= flicker_responses(cycle, frequency_hz, phase, start_us)
        total = 0.0
        for values in (rise[on], -rise[~on]):
            if len(values):
                middle = float(np.median(values))
                total += float(np.median(np.abs(values - middle))) / middle if middle > 0 else 10.0
        return total

    grid = np.arange(PHASES) * (2 * math.pi / PHASES)
    best = grid[np.argmin([unequal(phase) for phase in grid])]
    width = 2 * math.pi / PHASES
    return float(minimize_scalar(unequal, bounds=(best - width, best + width), method="bounded").x)
