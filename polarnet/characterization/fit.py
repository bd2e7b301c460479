"""A sensor fitted to the recordings of one camera: every parameter with its standard error and its source."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from polarnet.characterization.flicker import (
    GROUPS,
    Flicker,
    Source,
    bandwidth,
    increments_of,
    source_of,
    thresholds_without_leak,
)
from polarnet.characterization.noise import Noise, estimate_noise, hot_under_constant_light, nominal_shot_noise_hz
from polarnet.characterization.thresholds import Estimate, PixelThresholds, correlation, deviation
from polarnet.events.intervals import by_pixel, chosen_pixels, intervals_of
from polarnet.events.stream import Events
from polarnet.simulation.pixels.physics import PixelConfig
from polarnet.terminal.progress import ProgressBar

MAX_LEAK_ERROR = 0.05  # relative; above it shot noise hides the leak, and its error is unreliable
MIN_PIXELS = 50
PILE_UP = 3.0  # intervals of 0.9 to 1.1 times the shortest, over those of 1.1 to 1.3 times the shortest
MIN_TICKS = 5  # ticks of the recording's clock in the shortest refractory period that can be measured
MAX_SWING = 0.3  # relative swing of the OFF rate under constant light; larger: something moved or flickered
FLICKER_PARAMETERS = (
    "contrast_threshold_on", "contrast_threshold_off", "contrast_threshold_sigma_on", "contrast_threshold_sigma_off",
    "contrast_threshold_correlation", "cutoff_hz",
)  # fmt: skip
CONSTANT_LIGHT_PARAMETERS = ("shot_noise_rate_hz", "hot_pixel_share", "hot_pixel_rate_hz")


@dataclass
class SensorFit:
    """Estimates by parameter, and the reason for each parameter without one."""

    estimates: dict[str, Estimate] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def enter(self, name: str, estimate: Estimate | None, reason: str) -> None:
        """Enter an estimate, or the reason why there is none."""
        if estimate is None:
            self.missing[name] = reason
        else:
            self.estimates[name] = estimate

    def parameters(self) -> dict[str, float]:
        """Values for section `emulate` of params.yaml, rounded to four digits: only the estimated ones."""
        return {name: float(f"{one.value:.4g}") for name, one in self.estimates.items()}


def fit_sensor(
    static: Events | None, static_light: float, flickers: Sequence[tuple[Events, Flicker]], pixel: PixelConfig
) -> SensorFit:
    """Fit a sensor to recordings of one camera.

    `static` was recorded under constant light of `static_light` DN. `pixel` has the response to light, and the spread
    and the jitter of the leak. ValueError if nothing was recorded, or if the recordings are of sensors of different
    sizes.
    """
    recordings = [*([] if static is None else [static]), *(events for events, _ in flickers)]
    sizes = {(one.height, one.width) for one in recordings}
    if len(sizes) != 1:
        raise ValueError(f"expected recordings of one sensor, got sizes {sorted(sizes)} (height, width)")
    fit = SensorFit()
    ordered = [by_pixel(one) for one in ProgressBar(recordings, "sort", unit="recording")]
    noise = None
    if static is not None:
        noise = estimate_noise(ordered[0], hot_under_constant_light(static), pixel)
        ordered = [chosen_pixels(events, ~noise.hot) for events in ordered]  # hot pixels do not follow the light
        if noise.swing > MAX_SWING:
            fit.notes.append(
                f"the rate of OFF events in the static recording varies by {noise.swing:.0%} beyond chance: its light "
                f"was not constant, so its noise and hot pixels mean nothing; record a still scene"
            )
    dead_time = piled_up_us([intervals_of(one).duration_us for one in ordered])
    fit.enter("refractory_period_us", dead_time, "intervals between a pixel's events do not pile up at a minimum")
    leak = noise.leak if noise else None
    leak = leak if leak and leak.error <= MAX_LEAK_ERROR * leak.value else None
    reason = "under constant light, shot noise comes before the leak; record brighter"
    fit.enter("leak_rate_hz", leak, "needs a static recording" if noise is None else reason)
    shortest_us, flickering = dead_time.value if dead_time else 0.0, ordered[len(ordered) - len(flickers) :]
    recorded = ProgressBar(zip(flickers, flickering, strict=True), "fit", len(flickers), unit="recording")
    sources = [source_of(events, flicker, pixel, shortest_us) for (_, flicker), events in recorded]
    deviations = _fit_flicker(fit, sources, leak.value if leak else 0.0) if sources else (0.0, 0.0)
    if not sources:
        fit.missing |= dict.fromkeys(FLICKER_PARAMETERS, "needs a flicker recording")
    if noise is None:
        fit.missing |= dict.fromkeys(CONSTANT_LIGHT_PARAMETERS, "needs a static recording")
    else:
        _enter_noise(fit, noise, static_light, deviations)
    return fit


def piled_up_us(durations_us: Sequence[Float64[np.ndarray, " _"]]) -> Estimate | None:
    """Shortest interval, if intervals pile up there: crossings within the refractory period waited for its end."""
    durations = np.sort(np.concatenate(durations_us))
    durations = durations[durations > 0]
    supported = max(5, int(1e-5 * len(durations)))
    if len(durations) <= supported:
        return None
    shortest = durations[supported]
    tick_us = float(np.gcd.reduce(np.rint(durations).astype(np.int64)))  # step of the recording's clock
    if shortest < MIN_TICKS * tick_us:
        return None  # a coarse clock piles intervals up as well
    edges = np.searchsorted(durations, shortest * np.array([0.9, 1.1, 1.3]))
    piled, next_to = np.diff(edges)
    if piled < 20 or piled < PILE_UP * next_to:
        return None
    near = durations[edges[0] : edges[1]]
    return Estimate(float(np.median(near)), float(near.std()) / math.sqrt(len(near)), "shortest intervals of a pixel")


def _fit_flicker(fit: SensorFit, sources: Sequence[Source], leak_hz: float) -> tuple[float, float]:
    """Enter bandwidth and thresholds; returns the relative deviations of the ON and OFF thresholds."""
    pixels = sources[0].pixels
    names = " and ".join(source.name for source in sources)
    cutoff = bandwidth(sources, leak_hz)
    fit.enter("cutoff_hz", cutoff, "the light changes too slowly; add a flicker near the bandwidth")
    pair = thresholds_without_leak(increments_of(sources, cutoff.value if cutoff else 0.0), leak_hz, pixels)
    deviations = []
    for polarity, thresholds in zip(("on", "off"), pair, strict=True):
        values = thresholds.threshold[np.isfinite(thresholds.threshold)]
        if len(values) < MIN_PIXELS:
            raise ValueError(
                f"{names}: expected {polarity.upper()} thresholds of at least {MIN_PIXELS} pixels, got {len(values)}; "
                f"record for longer, with more contrast, and check the frequency"
            )
        if len(values) < 0.9 * pixels:
            fit.notes.append(
                f"{1 - len(values) / pixels:.0%} of the pixels have too few {polarity.upper()} events for a threshold; "
                f"if those are the pixels of high threshold, mean and deviation are too small: record for longer"
            )
        source = f"{names}, {len(values):,} pixels, increments within {thresholds.scale:.1%}"
        mean, sigma = float(np.median(values)), deviation(thresholds)
        error = 1.2533 * float(values.std()) / math.sqrt(len(values))
        fit.estimates[f"contrast_threshold_{polarity}"] = Estimate(mean, error, source)
        error = _grouped_error(lambda some: deviation(some[0]), [thresholds])
        fit.estimates[f"contrast_threshold_sigma_{polarity}"] = Estimate(sigma, error, "two halves of these")
        deviations.append(sigma / mean)
    error = _grouped_error(lambda some: correlation(*some), list(pair))
    common = Estimate(correlation(*pair), error, "ON and OFF of each pixel")
    reason = "the thresholds do not differ between pixels"
    fit.enter("contrast_threshold_correlation", common if math.isfinite(common.value) else None, reason)
    return deviations[0], deviations[1]


def _grouped_error(function: Callable[[list[PixelThresholds]], float], thresholds: list[PixelThresholds]) -> float:
    """Standard error of a value over all pixels, from its spread over groups of pixels."""
    values = [
        function([PixelThresholds(one.threshold[g::GROUPS], one.halves[:, g::GROUPS], one.scale) for one in thresholds])
        for g in range(GROUPS)
    ]
    values = [value for value in values if math.isfinite(value)]
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def _enter_noise(fit: SensorFit, noise: Noise, light: float, deviations: tuple[float, float]) -> None:
    """Enter shot noise and hot pixels; `deviations` are the relative ones of the thresholds."""
    value = nominal_shot_noise_hz(noise.shot_hz, light, *deviations)
    source = f"{noise.duration_s:.0f} s under constant light of {light:g} DN"
    fit.estimates["shot_noise_rate_hz"] = Estimate(value, value * noise.shot_error_hz / noise.shot_hz, source)
    count, rates_hz = len(noise.hot_rates_hz), noise.hot_rates_hz
    source = "more than 10 times the events of their neighbours under constant light"
    share = Estimate(float(noise.hot.mean()), math.sqrt(max(count, 1)) / len(noise.hot), source)
    fit.estimates["hot_pixel_share"] = share
    mean = None
    if count:
        spread_hz = float(rates_hz.std(ddof=1)) if count > 1 else float(rates_hz[0])
        mean = Estimate(float(rates_hz.mean()), spread_hz / math.sqrt(count), f"{count:,} hot pixels")
    fit.enter("hot_pixel_rate_hz", mean, "there are no hot pixels")
