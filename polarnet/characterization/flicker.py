"""A sinusoidal flicker on all pixels of a camera gives each pixel's contrast thresholds, and the bandwidth.

Light is in digital numbers (DN): 0 is dark, 255 white. The flicker gives the change of filtered log light between two
events of a pixel, its increment. An increment of duration T that ends with an ON event is (1 - r T) ON thresholds for a
leak of r hertz; with an OFF event, one OFF threshold plus r T ON thresholds; with shot noise, anything below. A pixel's
threshold comes from its increments (`thresholds`). The bandwidth is the one for which increments are closest to one
threshold.
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

from polarnet.characterization.thresholds import Estimate, PixelThresholds, misfit, pixel_thresholds
from polarnet.events.intervals import Intervals, PixelEvents, intervals_of
from polarnet.simulation.pixels.light import FULL_SCALE, respond_as_v2e
from polarnet.simulation.pixels.physics import DARK_OFFSET, SATURATION, PixelConfig, physics_of

STEPS_PER_CYCLE = 256  # linear pieces of a cycle: 3e-4 of the contrast off at most
PHASES = 32
PHASE_INTERVALS = 6000  # intervals that the phase is fitted to
BLOCK = 8  # consecutive intervals; even blocks make one half of the data, odd blocks the other
LEAKED = 0.25  # of a threshold: an interval in which the leak alone makes more is not used
GROUPS = 8  # groups of pixels, whose differences give standard errors
MAX_RELATIVE_ERROR = 0.5  # a bandwidth with a larger standard error is discarded
CUTOFF_PIXELS = 600  # pixels that the bandwidth is fitted to
CUTOFF_GRID = np.geomspace(5, 2500, 14)  # Hz, first guesses


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
    """Intervals of a recording under a flicker, and the filtered response at times in us for a bandwidth."""

    name: str
    intervals: Intervals
    responses: Callable[[Float64[np.ndarray, " n"], float], Float64[np.ndarray, " n"]]
    pixels: int
    """Number of pixels of the sensor."""


class Increments(NamedTuple):
    """Changes of the filtered log light between two events of a pixel, times the polarity of the second event."""

    increment: Float64[np.ndarray, " n"]
    duration_s: Float64[np.ndarray, " n"]
    pixel: Int64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]
    block: Int64[np.ndarray, " n"]


def undisturbed(intervals: Intervals, refractory_us: float) -> Intervals:
    """Intervals longer than 1.3 times the refractory period, except those right after a shorter one.

    A crossing within the refractory period waits for its end: its increment exceeds one threshold, and the next
    increment lacks the excess.
    """
    free = intervals.duration_us > 1.3 * refractory_us
    after_waiting = np.zeros(len(free), bool)
    after_waiting[1:] = (intervals.pixel[1:] == intervals.pixel[:-1]) & ~free[:-1]
    return intervals.chosen(free & ~after_waiting)


def source_of(events: PixelEvents, stated: Flicker, pixel: PixelConfig, refractory_us: float) -> Source:
    """The intervals of a recording under a flicker, of unknown phase, that the refractory period does not disturb."""
    intervals = undisturbed(intervals_of(events), refractory_us)
    flicker = exact_frequency(stated, events)

    @functools.cache
    def cycle_and_phase(cutoff_hz: float) -> tuple[Float64[np.ndarray, " k"], float]:
        cycle = flicker_cycle(flicker, pixel, cutoff_hz)
        return cycle, flicker_phase(cycle, flicker.frequency_hz, intervals)

    def responses(t_us: Float64[np.ndarray, " n"], cutoff_hz: float) -> Float64[np.ndarray, " n"]:
        cycle, phase = cycle_and_phase(cutoff_hz)
        return flicker_responses(cycle, flicker.frequency_hz, phase, t_us)

    return Source(f"flicker {stated.frequency_hz:g} Hz", intervals, responses, events.pixels)


def increments_of(sources: Sequence[Source], cutoff_hz: float) -> Increments:
    """Increments of all sources, for a photoreceptor of bandwidth `cutoff_hz` at full brightness (0: infinite)."""
    parts = []
    for source in sources:
        intervals = source.intervals
        before, after = (source.responses(t_us, cutoff_hz) for t_us in (intervals.start_us, intervals.stop_us))
        increment = intervals.polarity * (after - before)
        block = np.arange(len(increment)) // BLOCK
        parts.append((increment, intervals.duration_us * 1e-6, intervals.pixel, intervals.on, block))
    return Increments(*map(np.concatenate, zip(*parts, strict=True)))


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


def flicker_phase(cycle: Float64[np.ndarray, " k"], frequency_hz: float, intervals: Intervals) -> float:
    """Phase of the flicker at time 0, radians, which makes the increments of each polarity most nearly equal."""
    some = intervals.chosen(slice(None, None, max(1, len(intervals.pixel) // PHASE_INTERVALS)))

    def unequal(phase: float) -> float:
        rise = flicker_responses(cycle, frequency_hz, phase, some.stop_us)
        rise -= flicker_responses(cycle, frequency_hz, phase, some.start_us)
        total = 0.0
        for values in (rise[some.on], -rise[~some.on]):
            if len(values):
                middle = float(np.median(values))
                total += float(np.median(np.abs(values - middle))) / middle if middle > 0 else 10.0
        return total

    grid = np.arange(PHASES) * (2 * math.pi / PHASES)
    best = grid[np.argmin([unequal(phase) for phase in grid])]
    width = 2 * math.pi / PHASES
    return float(minimize_scalar(unequal, bounds=(best - width, best + width), method="bounded").x)


def thresholds_without_leak(data: Increments, leak_hz: float, pixels: int) -> tuple[PixelThresholds, PixelThresholds]:
    """Thresholds of both polarities, ON and OFF, with the leak taken out of the increments."""

    def pair(leaked: Float64[np.ndarray, " n"], usable: Bool[np.ndarray, " n"]) -> list[PixelThresholds]:
        increment = data.increment + np.where(data.on, leaked, -leaked)
        return [
            pixel_thresholds(increment[chosen], data.pixel[chosen], data.block[chosen], pixels)
            for chosen in (data.on & usable, ~data.on & usable)
        ]

    on, off = pair(np.zeros(len(data.on)), np.ones(len(data.on), np.bool_))
    if leak_hz:
        threshold = np.where(np.isfinite(on.threshold), on.threshold, np.nanmedian(on.threshold))
        leaked = leak_hz * data.duration_s
        on, off = pair(leaked * threshold[data.pixel], leaked < LEAKED)
    return on, off


def bandwidth(sources: Sequence[Source], leak_hz: float) -> Estimate | None:
    """Bandwidth in Hz; None if the data do not determine it."""
    pixels = sources[0].pixels
    busy = np.flatnonzero(sum(np.bincount(source.intervals.pixel, minlength=pixels) for source in sources) >= 2 * BLOCK)
    if len(busy) < GROUPS:
        return None
    chosen = busy[:: max(1, len(busy) // CUTOFF_PIXELS)]
    logs = []
    for group in range(GROUPS):
        mask = np.zeros(pixels, bool)
        mask[chosen[group::GROUPS]] = True
        some = [one._replace(intervals=one.intervals.chosen(mask[one.intervals.pixel])) for one in sources]

        def loss(log_hz: float, some=some) -> float:
            data = increments_of(some, math.exp(log_hz))
            try:
                pair = thresholds_without_leak(data, leak_hz, pixels)
            except ValueError:
                return 2.0
            total = 0.0
            for of, thresholds in zip((data.on, ~data.on), pair, strict=True):
                valid = of & np.isfinite(thresholds.threshold[data.pixel])
                total += misfit(data.increment[valid], data.pixel[valid], thresholds.threshold) if valid.any() else 1.0
            return total

        grid = np.log(CUTOFF_GRID)
        losses = [loss(x) for x in grid]
        k = int(np.argmin(losses))
        if k == 0 or k == len(grid) - 1 or losses[k] > 0.98 * losses[-1]:
            continue
        bounds = (grid[k - 1], grid[k + 1])
        logs.append(minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 0.01}).x)
    if len(logs) < GROUPS // 2 + 1 or np.std(logs, ddof=1) / math.sqrt(len(logs)) > MAX_RELATIVE_ERROR:
        return None
    value = math.exp(float(np.median(logs)))
    names = " and ".join(source.name for source in sources)
    return Estimate(value, value * float(np.std(logs, ddof=1)) / math.sqrt(len(logs)), f"{names}, whole increments")
