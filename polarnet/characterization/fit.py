"""A sensor fitted to the recordings of one camera: every parameter with its standard error and its source."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import minimize_scalar

from polarnet.characterization.increments import (
    Intervals,
    PixelEvents,
    by_pixel,
    chosen_pixels,
    intervals_of,
    undisturbed,
)
from polarnet.characterization.light import Flicker, MovingLight, flicker_cycle, flicker_responses, moving_responses
from polarnet.characterization.noise import HOT_FACTOR, Noise, estimate_noise, nominal_shot_noise_hz
from polarnet.characterization.thresholds import (
    PixelThresholds,
    correlation,
    deviation,
    misfit,
    pixel_thresholds,
)
from polarnet.events.stream import Events

GROUPS = 8  # of pixels, whose differences give standard errors
SETTLING_US = 100_000  # after the first frame, whose photoreceptor state is unknown
BLOCK = 8  # consecutive intervals of a pixel in one half of the data
CUTOFF_PIXELS = 600  # pixels that the bandwidth is fitted to
CUTOFF_GRID = np.geomspace(5, 2500, 14)  # Hz
MAX_RELATIVE_ERROR = 0.5  # an estimate with a larger standard error is none
TRUSTED_LEAK = 0.1  # relative error below which the leak under constant light needs no second source
LEAKED = 0.25  # intervals in which the leak alone makes this part of a threshold tell nothing of thresholds
MIN_PIXELS = 50
PILE_UP = 3.0  # times more intervals within 10 % of the shortest than in the next 10 %
MIN_TICKS = 5  # of the recording's clock, in a refractory period that can be told from it
PHASES = 32
PHASE_INTERVALS = 6000  # that the phase of a flicker is fitted to


class Estimate(NamedTuple):
    """A parameter of the sensor."""

    value: float
    error: float
    """Standard error."""
    source: str


@dataclass(frozen=True)
class KnownLight:
    """A recording under known light."""

    name: str
    events: Events
    light: MovingLight | Flicker


@dataclass(frozen=True)
class SensorFit:
    """Estimates by parameter, and the reason for each parameter without one."""

    estimates: Mapping[str, Estimate]
    missing: Mapping[str, str]
    notes: Sequence[str]


class _Source(NamedTuple):
    """Intervals of a recording under known light, and the filtered response at its events for a bandwidth."""

    name: str
    events: PixelEvents
    intervals: Intervals
    responses: Callable[[PixelEvents, float], Float64[np.ndarray, " n"]]
    moves: bool
    """Whether the light is one of frames."""


class _Increments(NamedTuple):
    """Increments in the direction of the events' polarity."""

    increment: Float64[np.ndarray, " n"]
    duration_s: Float64[np.ndarray, " n"]
    pixel: Int64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]
    block: Int64[np.ndarray, " n"]


class _Pair(NamedTuple):
    on: PixelThresholds
    off: PixelThresholds


def fit_sensor(
    static: Events | None, static_light: float, known: Sequence[KnownLight], others: Sequence[Events] = ()
) -> SensorFit:
    """Fit a sensor to recordings of one camera.

    `static` was recorded under constant light of `static_light` DN; `known` under known light; `others` under light
    that is not known. ValueError if nothing was recorded, or if the recordings are of sensors of different sizes.
    """
    recordings = [*([] if static is None else [static]), *(one.events for one in known), *others]
    if not recordings:
        raise ValueError("expected at least one recording; give a static, a moving or a flicker recording")
    sizes = {(one.height, one.width) for one in recordings}
    if len(sizes) > 1:
        raise ValueError(f"expected recordings of one sensor, got sizes {sorted(sizes)} (height, width)")
    ordered = [by_pixel(one) for one in recordings]
    estimates: dict[str, Estimate] = {}
    missing: dict[str, str] = {}
    notes: list[str] = []
    noise = estimate_noise(ordered[0]) if static is not None else None
    if noise is not None:
        ordered = [chosen_pixels(events, ~noise.hot) for events in ordered]  # hot pixels do not follow the light
    dead_time = refractory_period_us([intervals_of(one).duration_us for one in ordered])
    _enter(estimates, missing, "refractory_period_us", dead_time, "no intervals of a pixel pile up at a shortest one")
    shortest_us = dead_time.value if dead_time else 0.0
    first = 0 if static is None else 1
    sources = [
        _source(one, events, shortest_us)
        for one, events in zip(known, ordered[first : first + len(known)], strict=True)
    ]
    leak = _leak_of(noise)
    deviations = (0.0, 0.0)
    if sources:
        pair, drift = _fit_known(sources, leak, estimates, missing, notes)
        leak = _better(leak, drift)
        on, off = (estimates[f"contrast_threshold_{p}"].value for p in ("on", "off"))
        deviations = deviation(pair.on) / on, deviation(pair.off) / off
    else:
        for name in KNOWN_LIGHT_PARAMETERS:
            missing[name] = "needs a moving recording with frames, or a flicker recording"
    _enter_noise(estimates, missing, notes, noise, leak, static_light, deviations)
    return SensorFit(estimates, missing, notes)


KNOWN_LIGHT_PARAMETERS = (
    "contrast_threshold_on",
    "contrast_threshold_off",
    "contrast_threshold_sigma_on",
    "contrast_threshold_sigma_off",
    "contrast_threshold_correlation",
    "cutoff_hz",
)
CONSTANT_LIGHT_PARAMETERS = (
    "shot_noise_rate_hz",
    "noise_rate_cov_decades",
    "leak_jitter",
    "hot_pixel_share",
    "hot_pixel_rate_hz",
)


def refractory_period_us(durations_us: Sequence[Float64[np.ndarray, " _"]]) -> Estimate | None:
    """Shortest interval between events of a pixel, if intervals pile up there: crossings waited for its end."""
    durations = np.concatenate(durations_us) if durations_us else np.empty(0)
    durations = np.sort(durations[durations > 0])
    supported = max(5, int(1e-5 * len(durations)))
    if len(durations) <= supported:
        return None
    tick_us = float(np.gcd.reduce(np.rint(durations).astype(np.int64)))
    shortest = durations[supported]
    if shortest < MIN_TICKS * tick_us:
        return None  # a coarse clock piles intervals up as well
    edges = np.searchsorted(durations, shortest * np.array([0.9, 1.1, 1.3]))
    piled, next_to = np.diff(edges)
    if piled < 20 or piled < PILE_UP * next_to:
        return None
    near = durations[edges[0] : edges[1]]
    return Estimate(float(np.median(near)), float(near.std()) / math.sqrt(len(near)), "shortest intervals of a pixel")


def _enter(estimates, missing, name: str, estimate: Estimate | None, reason: str) -> None:
    if estimate is None:
        missing[name] = reason
    else:
        estimates[name] = estimate


def _source(known: KnownLight, events: PixelEvents, refractory_us: float) -> _Source:
    intervals = undisturbed(intervals_of(events), refractory_us)
    light = known.light
    if isinstance(light, MovingLight):
        after = events.t_us[intervals.start] >= light.t_us[0] + SETTLING_US
        intervals = Intervals(*(column[after] for column in intervals))

        def responses(some: PixelEvents, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
            return moving_responses(light, some.pixel, some.t_us, cutoff_hz)
    else:
        flicker = _exact_frequency(light, events)

        @functools.cache
        def cycle_and_phase(cutoff_hz: float) -> tuple[Float64[np.ndarray, " k"], float]:
            cycle = flicker_cycle(flicker, cutoff_hz)
            return cycle, flicker_phase(cycle, flicker.frequency_hz, events, intervals)

        def responses(some: PixelEvents, cutoff_hz: float) -> Float64[np.ndarray, " n"]:
            cycle, phase = cycle_and_phase(cutoff_hz)
            return flicker_responses(cycle, flicker.frequency_hz, phase, some.t_us)

    return _Source(known.name, events, intervals, responses, isinstance(light, MovingLight))


def _exact_frequency(flicker: Flicker, events: PixelEvents) -> Flicker:
    """The frequency on the recording's clock, from the drift of the events' phase between its two halves."""
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
    """Phase of the flicker at time 0: increments of one polarity are then most nearly equal."""
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


def _increments(sources: Sequence[_Source], cutoff_hz: float) -> _Increments:
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
    return _Increments(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))


def _thresholds(data: _Increments, leak_hz: float, pixels: int) -> _Pair:
    """Thresholds of both polarities, with the leak taken out of the increments.

    The leak of a pixel is a part of its ON threshold: the first pass, without it, gives that threshold.
    """
    leaked = np.zeros(len(data.increment))
    pair = None
    for leak in (0.0, leak_hz) if leak_hz > 0 else (0.0,):
        if pair is not None:
            typical = np.nanmedian(pair.on.threshold)
            threshold_on = np.where(np.isfinite(pair.on.threshold), pair.on.threshold, typical)
            leaked = leak * threshold_on[data.pixel] * data.duration_s * np.where(data.on, 1.0, -1.0)
        few_leaks = leak * data.duration_s < LEAKED
        halves = []
        for of in (data.on, ~data.on):
            chosen = of & few_leaks
            halves.append(
                pixel_thresholds((data.increment + leaked)[chosen], data.pixel[chosen], data.block[chosen], pixels)
            )
        pair = _Pair(*halves)
    assert pair is not None
    return pair


def _drift(data: _Increments, pair: _Pair) -> Estimate | None:
    """The leak from increments that shrink (ON) or grow (OFF) with an interval's duration, relative to the threshold.

    Shot noise that ends an interval shortens both kinds alike, so half their difference is free of it.
    """
    typical = np.nanmedian(pair.on.threshold)
    threshold_on = np.where(np.isfinite(pair.on.threshold), pair.on.threshold, typical)
    per_group = np.empty((2, GROUPS))
    for row, (of, thresholds) in enumerate(((data.on, pair.on), (~data.on, pair.off))):
        threshold = thresholds.threshold[data.pixel]
        error = data.increment / threshold - 1
        near = of & np.isfinite(error) & (np.abs(error) < max(4 * thresholds.scale, 0.02))
        pixel, duration_s = data.pixel[near], data.duration_s[near]
        excess = data.increment[near] / threshold_on[pixel]
        count = np.maximum(np.bincount(pixel, minlength=len(threshold_on)), 1)
        x = duration_s - (np.bincount(pixel, duration_s, len(count)) / count)[pixel]
        y = excess - (np.bincount(pixel, excess, len(count)) / count)[pixel]
        group = pixel % GROUPS
        per_group[row] = np.bincount(group, x * y, GROUPS) / np.maximum(np.bincount(group, x * x, GROUPS), 1e-12)
    leaks = 0.5 * (per_group[1] - per_group[0])
    estimate = Estimate(
        float(leaks.mean()), float(leaks.std(ddof=1)) / math.sqrt(GROUPS), "drift of increments under known light"
    )
    return estimate if estimate.value > 0 else None


def _fit_known(
    sources: Sequence[_Source], leak: Estimate | None, estimates, missing, notes: list[str]
) -> tuple[_Pair, Estimate | None]:
    """Bandwidth first, then thresholds and the leak's drift; enters the estimates."""
    pixels = sources[0].events.pixels
    names = " and ".join(source.name for source in sources)
    trusted = leak.value if leak is not None and leak.error < MAX_RELATIVE_ERROR * leak.value else 0.0
    cutoff = _cutoff(sources, trusted)
    _enter(estimates, missing, "cutoff_hz", cutoff, "the light changes too slowly; add a flicker near the bandwidth")
    data = _increments(sources, 0.0 if cutoff is None else cutoff.value)
    pair = _thresholds(data, trusted, pixels)
    moving = [source for source in sources if source.moves]
    drift = _drift(_increments(moving, 0.0 if cutoff is None else cutoff.value), pair) if moving else None
    better = _better(leak, drift)
    if better is not None and better is drift and drift.error < MAX_RELATIVE_ERROR * drift.value:
        pair = _thresholds(data, drift.value, pixels)
    for polarity, thresholds in zip(("on", "off"), pair, strict=True):
        values = thresholds.threshold[np.isfinite(thresholds.threshold)]
        if len(values) < MIN_PIXELS:
            raise ValueError(
                f"{names}: expected {polarity.upper()} thresholds of at least {MIN_PIXELS} pixels, got {len(values)}; "
                f"record for longer, with more contrast, and check that frames and events share clock and pixels"
            )
        source = f"{names}, {len(values):,} pixels, increments within {thresholds.scale:.1%}"
        spread = float(values.std())
        mean = Estimate(float(np.median(values)), 1.2533 * spread / math.sqrt(len(values)), source)
        estimates[f"contrast_threshold_{polarity}"] = mean
        estimates[f"contrast_threshold_sigma_{polarity}"] = Estimate(
            deviation(thresholds), _grouped_error(lambda some: deviation(some[0]), [thresholds]), "two halves of these"
        )
        if len(values) < 0.9 * pixels:
            notes.append(
                f"{1 - len(values) / pixels:.0%} of the pixels have too few {polarity.upper()} events for a threshold; "
                f"if those are the pixels of high threshold, mean and deviation are too small: record for longer"
            )
    common = Estimate(
        correlation(*pair), _grouped_error(lambda some: correlation(*some), list(pair)), "ON and OFF of each pixel"
    )
    estimate = common if math.isfinite(common.value) else None
    _enter(
        estimates, missing, "contrast_threshold_correlation", estimate, "the thresholds do not differ between pixels"
    )
    return pair, drift


def _grouped_error(function: Callable[[list[PixelThresholds]], float], thresholds: list[PixelThresholds]) -> float:
    """Standard error of a value over all pixels, from its spread over groups of pixels."""
    values = [
        function([PixelThresholds(one.threshold[g::GROUPS], one.halves[:, g::GROUPS], one.scale) for one in thresholds])
        for g in range(GROUPS)
    ]
    values = [value for value in values if math.isfinite(value)]
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def _cutoff(sources: Sequence[_Source], leak_hz: float) -> Estimate | None:
    """Bandwidth that makes increments most nearly whole thresholds; None where it makes no difference."""
    flickers = [source for source in sources if not source.moves]
    sources = flickers or sources
    pixels = sources[0].events.pixels
    busy = np.flatnonzero(sum(np.bincount(source.intervals.pixel, minlength=pixels) for source in sources) >= 2 * BLOCK)
    if len(busy) < GROUPS:
        return None
    chosen = busy[:: max(1, len(busy) // CUTOFF_PIXELS)]
    logs = []
    for group in range(GROUPS):
        mask = np.zeros(pixels, bool)
        mask[chosen[group::GROUPS]] = True
        some = [_of_pixels(source, mask) for source in sources]

        def loss(log_hz: float, some=some) -> float:
            data = _increments(some, math.exp(log_hz))
            try:
                pair = _thresholds(data, leak_hz, pixels)
            except ValueError:
                return 2.0
            total = 0.0
            for of, thresholds in ((data.on, pair.on), (~data.on, pair.off)):
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


def _of_pixels(source: _Source, mask: Bool[np.ndarray, " pixels"]) -> _Source:
    """The part of a source at some pixels."""
    selected = mask[source.events.pixel]
    number = np.cumsum(selected) - 1
    chosen = mask[source.intervals.pixel]
    start, stop = number[source.intervals.start[chosen]], number[source.intervals.stop[chosen]]
    rest = (column[chosen] for column in source.intervals[2:])
    return source._replace(events=chosen_pixels(source.events, mask), intervals=Intervals(start, stop, *rest))


def _leak_of(noise: Noise | None) -> Estimate | None:
    if noise is None:
        return None
    return Estimate(noise.leak_hz, noise.leak_error_hz, "ages of ON events under constant light")


def _better(leak: Estimate | None, drift: Estimate | None) -> Estimate | None:
    """The leak under constant light if it is precise, else the estimate of the smaller relative error."""
    if leak is None or drift is None:
        return leak or drift
    errors = leak.error / leak.value, drift.error / drift.value
    return leak if errors[0] < max(TRUSTED_LEAK, errors[1]) else drift


def _enter_noise(
    estimates, missing, notes, noise: Noise | None, leak: Estimate | None, light: float, deviations: tuple[float, float]
) -> None:
    if leak is not None and leak.error < MAX_RELATIVE_ERROR * leak.value:
        estimates["leak_rate_hz"] = leak
    else:
        missing["leak_rate_hz"] = (
            "needs a static recording" if noise is None else "shot noise comes long before the leak; record brighter"
        )
    if noise is None:
        for name in CONSTANT_LIGHT_PARAMETERS:
            missing[name] = "needs a static recording"
        return
    rate = noise.shot_on_hz + noise.shot_off_hz
    value = nominal_shot_noise_hz(rate, light, *deviations)
    source = f"{noise.duration_s:.0f} s under constant light of {light:g} DN"
    estimates["shot_noise_rate_hz"] = Estimate(value, value * noise.shot_error_hz / rate, source)
    _enter_hot(estimates, missing, noise)
    spreads = {
        "noise_rate_cov_decades": (noise.leak_spread_decades, noise.leak_spread_error),
        "leak_jitter": (noise.leak_jitter, noise.leak_jitter_error),
    }
    for name, (spread, error) in spreads.items():
        if error < 0.3 * spread:
            estimates[name] = Estimate(spread, error, "ages of ON events under constant light")
        else:
            missing[name] = "too few leak events"


def _enter_hot(estimates, missing, noise: Noise) -> None:
    """Share of hot pixels, with the error of a count, and their mean rate, with the error of a mean."""
    share, source = float(noise.hot.mean()), f"more than {HOT_FACTOR:g} times the median events under constant light"
    error = math.sqrt(max(noise.hot.sum(), 1)) / len(noise.hot)
    estimates["hot_pixel_share"] = Estimate(share, error, source)
    rates_hz = noise.hot_rates_hz
    if len(rates_hz):
        spread = float(rates_hz.std(ddof=1)) if len(rates_hz) > 1 else float(rates_hz[0])
        mean_error = spread / math.sqrt(len(rates_hz))
        estimates["hot_pixel_rate_hz"] = Estimate(float(rates_hz.mean()), mean_error, f"{len(rates_hz):,} hot pixels")
    else:
        missing["hot_pixel_rate_hz"] = "there are no hot pixels"
