"""A sensor fitted to the recordings of one camera: every parameter with its standard error and its source."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from polarnet.characterization.bandwidth import bandwidth
from polarnet.characterization.estimates import GROUPS, MAX_RELATIVE_ERROR, Estimate
from polarnet.characterization.increments import by_pixel, chosen_pixels, intervals_of
from polarnet.characterization.known_light import KnownLight, Source, increments_of, source_of
from polarnet.characterization.leak import PolarityThresholds, leak_drift, thresholds_without_leak
from polarnet.characterization.noise import (
    HOT_FACTOR,
    PRIOR_SPREAD_DECADES,
    Noise,
    estimate_noise,
    nominal_shot_noise_hz,
)
from polarnet.characterization.refractory import between_shot_noise_us, piled_up_us
from polarnet.characterization.thresholds import PixelThresholds, correlation, deviation
from polarnet.events.stream import Events

MAX_LEAK_ERROR = 0.05  # relative; above it shot noise hides the leak, and its error is unreliable
MIN_PIXELS = 50
MAX_SWING = 0.3  # relative swing of the OFF rate under constant light; larger: something moved or flickered


@dataclass(frozen=True)
class SensorFit:
    """Estimates by parameter, and the reason for each parameter without one."""

    estimates: Mapping[str, Estimate]
    missing: Mapping[str, str]
    notes: Sequence[str]


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
        if noise.swing > MAX_SWING:
            notes.append(
                f"the rate of OFF events in the static recording varies by {noise.swing:.0%} beyond chance: its light "
                f"was not constant, so its noise, hot pixels and refractory period mean nothing; record a still scene"
            )
    durations_us = [intervals_of(one).duration_us for one in ordered]
    dead_time = piled_up_us(durations_us) or (between_shot_noise_us(durations_us[0]) if noise else None)
    reason = "intervals between a pixel's events do not pile up at a minimum, and shot noise is too rare to show it"
    _enter(estimates, missing, "refractory_period_us", dead_time, reason)
    shortest_us = dead_time.value if dead_time else 0.0
    first = 0 if static is None else 1
    sources = [
        source_of(one, events, shortest_us)
        for one, events in zip(known, ordered[first : first + len(known)], strict=True)
    ]
    leak = None if noise is None else _leak_under_constant_light(noise)
    deviations = (0.0, 0.0)
    if sources:
        spread_decades = PRIOR_SPREAD_DECADES if noise is None else noise.leak_spread_decades
        pair, leak = _fit_known(sources, leak, spread_decades, estimates, missing, notes)
        on, off = (estimates[f"contrast_threshold_{p}"].value for p in ("on", "off"))
        deviations = deviation(pair.on) / on, deviation(pair.off) / off
    else:
        for name in KNOWN_LIGHT_PARAMETERS:
            missing[name] = "needs a moving recording with frames, or a flicker recording"
    _enter_noise(estimates, missing, notes, noise, leak, static_light, deviations)
    return SensorFit(estimates, missing, notes)


def _enter(estimates, missing, name: str, estimate: Estimate | None, reason: str) -> None:
    if estimate is None:
        missing[name] = reason
    else:
        estimates[name] = estimate


def _fit_known(
    sources: Sequence[Source], leak: Estimate | None, spread_decades: float, estimates, missing, notes: list[str]
) -> tuple[PolarityThresholds, Estimate | None]:
    """Thresholds, and the leak (from its drift if `leak` is None); adds bandwidth and thresholds to `estimates`."""
    pixels = sources[0].events.pixels
    names = " and ".join(source.name for source in sources)
    cutoff = bandwidth(sources, leak.value if leak else 0.0)
    _enter(estimates, missing, "cutoff_hz", cutoff, "the light changes too slowly; add a flicker near the bandwidth")
    cutoff_hz = cutoff.value if cutoff else 0.0
    moving = [source for source in sources if source.moves]
    if leak is None and moving:
        drift = leak_drift(increments_of(moving, cutoff_hz), pixels, spread_decades)
        leak = drift if drift and drift.error < MAX_RELATIVE_ERROR * drift.value else None
    pair = thresholds_without_leak(increments_of(sources, cutoff_hz), leak.value if leak else 0.0, pixels)
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
    return pair, leak


def _grouped_error(function: Callable[[list[PixelThresholds]], float], thresholds: list[PixelThresholds]) -> float:
    """Standard error of a value over all pixels, from its spread over groups of pixels."""
    values = [
        function([PixelThresholds(one.threshold[g::GROUPS], one.halves[:, g::GROUPS], one.scale) for one in thresholds])
        for g in range(GROUPS)
    ]
    values = [value for value in values if math.isfinite(value)]
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def _leak_under_constant_light(noise: Noise) -> Estimate | None:
    """The leak, unless shot noise hides it."""
    if noise.leak_error_hz > MAX_LEAK_ERROR * noise.leak_hz:
        return None
    return Estimate(noise.leak_hz, noise.leak_error_hz, "ages of ON events under constant light")


def _enter_noise(
    estimates, missing, notes, noise: Noise | None, leak: Estimate | None, light: float, deviations: tuple[float, float]
) -> None:
    reason = "under constant light, shot noise comes before the leak; record brighter, or a moving scene with frames"
    _enter(estimates, missing, "leak_rate_hz", leak, "needs a static recording" if noise is None else reason)
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
