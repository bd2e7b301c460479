"""Frequency and phase of a flicker on the clock of a recording, from the events alone."""

import math

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar

from polarnet.characterization.increments import Intervals, PixelEvents
from polarnet.characterization.light import Flicker, flicker_responses

PHASES = 32
PHASE_INTERVALS = 6000  # intervals that the phase of a flicker is fitted to


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
