"""Recordings under known light, and the change of the filtered log light between events of a pixel."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import minimize_scalar

from polarnet.characterization.increments import Intervals, PixelEvents, chosen_pixels, intervals_of, undisturbed
from polarnet.characterization.light import Flicker, MovingLight, flicker_cycle, flicker_responses, moving_responses
from polarnet.events.stream import Events

SETTLING_US = 100_000  # after the first frame, left out, because the photoreceptor's state is unknown
PHASES = 32
PHASE_INTERVALS = 6000  # intervals that the phase of a flicker is fitted to
BLOCK = 8  # consecutive intervals; even blocks make one half of the data, odd blocks the other


@dataclass(frozen=True)
class KnownLight:
    """A recording under known light."""

    name: str
    events: Events
    light: MovingLight | Flicker


class Source(NamedTuple):
    """Intervals of a recording under known light, and the filtered response at its events for a bandwidth."""

    name: str
    events: PixelEvents
    intervals: Intervals
    responses: Callable[[PixelEvents, float], Float64[np.ndarray, " n"]]
    moves: bool
    """Whether the light is a moving scene with frames, not a flicker."""


class Increments(NamedTuple):
    """Changes of the filtered log light between two events of a pixel, times the polarity of the second event."""

    increment: Float64[np.ndarray, " n"]
    duration_s: Float64[np.ndarray, " n"]
    pixel: Int64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]
    block: Int64[np.ndarray, " n"]


def source_of(known: KnownLight, events: PixelEvents, refractory_us: float) -> Source:
    """The intervals of a recording under known light that neither start-up nor refractory period disturbs."""
    intervals = undisturbed(intervals_of(events), refractory_us)
    light = known.light
    if isinstance(light, MovingLight):
        after = events.t_us[intervals.start] >= light.t_us[0] + SETTLING_US
        intervals = Intervals(*(column[after] for column in intervals))

        def responses(some: PixelEvents, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
            return moving_responses(light, some.pixel, some.t_us, cutoff_hz)
    else:
        flicker = exact_frequency(light, events)

        @functools.cache
        def cycle_and_phase(cutoff_hz: float) -> tuple[Float64[np.ndarray, " k"], float]:
            cycle = flicker_cycle(flicker, cutoff_hz)
            return cycle, flicker_phase(cycle, flicker.frequency_hz, events, intervals)

        def responses(some: PixelEvents, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
            cycle, phase = cycle_and_phase(cutoff_hz)
            return flicker_responses(cycle, flicker.frequency_hz, phase, some.t_us)

    return Source(known.name, events, intervals, responses, isinstance(light, MovingLight))


def increments_of(sources: Sequence[Source], cutoff_hz: float) -> Increments:
    """Increments of all sources, for a photoreceptor of bandwidth `cutoff_hz` at full brightness (0: infinite)."""
    columns: list[tuple[np.ndarray, ...]] = []
    for source in sources:
        response, intervals = source.responses(source.events, cutoff_hz), source.intervals
        sign = np.where(intervals.on, 1.0, -1.0)
        increment = sign * (response[intervals.stop] - response[intervals.start])
        covered = np.isfinite(increment)
        columns.append(
            tuple(
                column[covered]
                for column in (
                    increment,
                    intervals.duration_us * 1e-6,
                    intervals.pixel,
                    intervals.on,
                    np.arange(len(increment)) // BLOCK,
                )
            )
        )
    return Increments(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))


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
        phasors = np.histogram(t_s, edges, weights=sign * np.cos(2 * math.pi * frequency * (t_s - middle)))[0] - (
            1j * np.histogram(t_s, edges, weights=sign * np.sin(2 * math.pi * frequency * (t_s - middle)))[0]
        )
        turn = np.angle((phasors[1:] * phasors[:-1].conj()).sum())
        frequency += turn / (2 * math.pi * (edges[1] - edges[0]))
    return Flicker(flicker.level, flicker.contrast, float(frequency))


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
