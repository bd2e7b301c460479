"""Leak, shot noise and hot pixels of a sensor under constant light.

OFF events under constant light are shot noise, a Poisson process. ON events are shot noise or the leak, which fires a
pixel at about the same time after each of its events: at age T = tau / (1 - jitter z) with z normal, where 1 / tau is
log-normal over the pixels. Both processes start anew with each event of the pixel.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import minimize

from polarnet.characterization.intervals import Estimate, PixelEvents, chosen_pixels, intervals_of
from polarnet.events.stream import Events
from polarnet.recordings.noise import event_counts, hot_pixels
from polarnet.simulation.compilation import compiled
from polarnet.simulation.pixels.physics import shot_noise_fraction

NOISE_HOT_FACTOR = 10.0  # of `hot_pixels` under constant light: thresholds alone make no pixel so busy
NODES = np.linspace(-3, 3, 61)  # leaks of the pixels, standard deviations from the median
NODE_WEIGHTS = np.exp(-(NODES**2) / 2) / np.exp(-(NODES**2) / 2).sum()
MAX_LEAKS, MAX_AGES = 20_000, 250_000  # in the fit of the leak, which uses fewer pixels if there are more
PRIOR_SPREAD_DECADES, PRIOR_JITTER, PRIOR_WIDTH = 0.1, 0.1, 0.5  # v2e's values; standard deviation of the logarithm
YOUNG = 0.4  # ages below this part of the mean leak interval see shot noise alone
FAR = 6.0  # standard deviations beyond which the leak is certain not to have fired
SHORTEST_S = 1e-6
SWING_PARTS = 20


class Noise(NamedTuple):
    """Noise of a sensor under constant light, events per pixel and second."""

    leak: Estimate
    """Median over the pixels."""
    leak_spread: Estimate
    """Standard deviation over the pixels, decades."""
    leak_jitter: Estimate
    shot_on_hz: float
    """Mean over the pixels."""
    shot_off_hz: float
    shot_error_hz: float
    """Standard error of the sum of both means."""
    hot: Bool[np.ndarray, " pixels"]
    hot_rates_hz: Float64[np.ndarray, " hot"]
    """Events per second of each hot pixel."""
    duration_s: float
    swing: float
    """Relative standard deviation of the OFF rate over 20 parts of the time, beyond chance; 0 under constant light."""


class _Ages(NamedTuple):
    """Times from one event of a pixel to the next, or to the end of the recording, ordered by pixel."""

    starts: Int64[np.ndarray, " pixels_and_one"]
    age_s: Float64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]


def hot_under_constant_light(events: Events) -> Bool[np.ndarray, " pixels"]:
    """Hot pixels, however slow: those with more than ten times the events of the pixels around them."""
    return hot_pixels(event_counts(events), 1.0, NOISE_HOT_FACTOR, min_hz=0.0).ravel()


def estimate_noise(events: PixelEvents, hot: Bool[np.ndarray, " pixels"]) -> Noise:
    """Noise from a recording of constant light, with its hot pixels; ValueError with fewer than 100 events."""
    if len(events.t_us) < 100:
        raise ValueError(
            f"expected at least 100 events under constant light, got {len(events.t_us)}; record for longer"
        )
    counts = np.bincount(events.pixel, minlength=events.pixels)
    good = int((~hot).sum())
    duration_s = float(np.ptp(events.t_us)) * 1e-6
    ordinary = chosen_pixels(events, ~hot)
    off = np.bincount(ordinary.pixel[~ordinary.on], minlength=events.pixels)[~hot] / duration_s
    shot_off = float(off.mean())
    leaks = int(ordinary.on.sum()) - int((~ordinary.on).sum())
    every = max(1, math.ceil(leaks / MAX_LEAKS), math.ceil(len(ordinary.on) / MAX_AGES))
    some = chosen_pixels(ordinary, np.arange(events.pixels) % every == 0)
    fit, error = _fit_leak(_ages(some), max(shot_off, 1 / (good * duration_s)))
    leak, spread, jitter = (
        Estimate(math.exp(x), math.exp(x) * relative, "ages of ON events under constant light")
        for x, relative in zip(fit[1:].tolist(), error[1:].tolist(), strict=True)
    )
    ages, young_s = _ages(ordinary), YOUNG * math.exp(-fit[1])  # which the leak does not reach
    shot_on = float((ages.on & (ages.age_s < young_s)).sum() / np.minimum(ages.age_s, young_s).sum())
    poisson = math.sqrt((shot_on + shot_off) / (good * duration_s))
    between = float(off.std()) / math.sqrt(good)
    return Noise(
        leak=leak,
        leak_spread=spread,
        leak_jitter=jitter,
        shot_on_hz=shot_on,
        shot_off_hz=shot_off,
        shot_error_hz=max(poisson, between),
        hot=hot,
        hot_rates_hz=counts[hot] / duration_s,
        duration_s=duration_s,
        swing=rate_swing(ordinary.t_us[~ordinary.on], events.t_us),
    )


def rate_swing(times_us: Float64[np.ndarray, " n"], every_us: Float64[np.ndarray, " m"]) -> float:
    """Relative standard deviation of a rate over the time of all events (`every_us`), less that of Poisson events."""
    if len(times_us) == 0:
        return 0.0
    counts, _ = np.histogram(times_us, SWING_PARTS, (every_us.min(), every_us.max()))
    return math.sqrt(max(counts.var(ddof=1) - counts.mean(), 0.0)) / float(counts.mean())


def nominal_shot_noise_hz(rate_hz: float, light: float, deviation_on: float, deviation_off: float) -> float:
    """`shot_noise_rate_hz` of a sensor whose pixels fire `rate_hz` (ON and OFF) on average at `light` DN.

    The rate of a pixel is inversely proportional to its thresholds, so the mean exceeds that of a nominal pixel. The
    deviations of the thresholds are relative.
    """
    excess = 0.5 * (mean_inverse(deviation_on) + mean_inverse(deviation_off))
    return rate_hz / (float(shot_noise_fraction(light)) * excess)


def mean_inverse(relative_deviation: float) -> float:
    """Mean of 1 / x over normally distributed x of mean 1, without x below 0.1: those pixels are hot."""
    z = np.linspace(-5, 5, 2001)
    x = 1 + relative_deviation * z
    z, x = z[x >= 1 / NOISE_HOT_FACTOR], x[x >= 1 / NOISE_HOT_FACTOR]
    density = np.exp(-z * z / 2)
    return float((density / x).sum() / density.sum())


def _ages(events: PixelEvents) -> _Ages:
    intervals = intervals_of(events)
    last = np.flatnonzero(np.append(events.pixel[1:] != events.pixel[:-1], True))
    pixel = np.concatenate([intervals.pixel, events.pixel[last]])
    stop_us = events.t_us.max()
    age_s = np.concatenate([intervals.duration_us, stop_us - events.t_us[last]]) * 1e-6
    on = np.concatenate([intervals.on, np.zeros(len(last), bool)])
    order = np.argsort(pixel, kind="stable")
    pixel = pixel[order]
    _, first = np.unique(pixel, return_index=True)
    return _Ages(np.append(first, len(pixel)), np.maximum(age_s[order], SHORTEST_S), on[order])


def _fit_leak(ages: _Ages, shot_guess_hz: float) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 4"]]:
    """Most likely logarithms of (ON shot noise, leak, its spread in decades, its jitter), and their errors."""
    exposure_s, on = np.add.reduceat(ages.age_s, ages.starts[:-1]), np.add.reduceat(ages.on, ages.starts[:-1])
    factor = np.ones(len(exposure_s))

    def loss(x: Float64[np.ndarray, " 4"]) -> float:
        priors = ((x[2] - math.log(PRIOR_SPREAD_DECADES)) ** 2 + (x[3] - math.log(PRIOR_JITTER)) ** 2) / PRIOR_WIDTH**2
        rates = math.exp(x[0]) * factor
        leaks_s = np.exp(-x[1] - math.log(10) * math.exp(x[2]) * NODES)
        likelihood = _likelihoods(ages.starts, ages.age_s, ages.on, rates, leaks_s, math.exp(x[3]))
        most = likelihood.max(axis=1)
        total = most + np.log(np.exp(likelihood - most[:, None]) @ NODE_WEIGHTS)
        return 0.5 * priors - float(total.sum())

    priors = [math.log(PRIOR_SPREAD_DECADES), math.log(PRIOR_JITTER)]
    excess_hz = max(on.sum() / exposure_s.sum() - shot_guess_hz, 0.02 * shot_guess_hz, 1e-4)
    starts = [
        excess_hz,
        1 / float(np.median(ages.age_s[ages.on] if ages.on.any() else ages.age_s)),
        *(f * (shot_guess_hz + excess_hz) for f in (1.0, 0.3, 0.1)),
    ]
    first = min(
        ([math.log(shot_guess_hz), math.log(leak), *priors] for leak in starts), key=lambda x: loss(np.array(x))
    )
    x = _minimised(loss, first)
    # the shot noise of a pixel depends on its threshold: its share of young ON events, shrunk to the mean
    young_s = YOUNG * math.exp(-x[1])
    young_events = np.add.reduceat(ages.on & (ages.age_s < young_s), ages.starts[:-1])
    at_risk_s = np.add.reduceat(np.minimum(ages.age_s, young_s), ages.starts[:-1])
    expected = math.exp(x[0]) * at_risk_s
    excess_variance = ((young_events - expected) ** 2 - expected).sum() / max((expected**2).sum(), 1e-12)
    if excess_variance > 1e-3:
        factor = (1 / excess_variance + young_events) / (1 / excess_variance + expected)
        x = _minimised(loss, x)
    return x, _errors(loss, x)


def _minimised(loss, start) -> Float64[np.ndarray, " 4"]:
    options = {"xatol": 5e-3, "fatol": 0.05, "maxfev": 220}
    simplex = np.array(start) + np.vstack([np.zeros(4), np.diag([0.1, 0.3, 0.3, 0.3])])
    return minimize(loss, simplex[0], method="Nelder-Mead", options={**options, "initial_simplex": simplex}).x


def _errors(loss, x) -> Float64[np.ndarray, " 4"]:
    """Standard errors from the curvature of the loss; infinite where it has none."""
    step, n = 0.03, len(x)
    unit = np.eye(n) * step
    curvature = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            four = [loss(x + a * unit[i] + b * unit[j]) for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            curvature[i, j] = curvature[j, i] = (four[0] - four[1] - four[2] + four[3]) / (4 * step * step)
    values, vectors = np.linalg.eigh(curvature)
    return np.sqrt((vectors**2 / np.maximum(values, 1e-6)).sum(axis=1))


@compiled
def _likelihoods(starts, age_s, on, rate_hz, leak_s, jitter):
    """Log-likelihood of each pixel's ages for each mean leak interval, without the terms common to all."""
    values = np.empty((starts.size - 1, leak_s.size))
    for i in range(starts.size - 1):
        for q in range(leak_s.size):
            tau, total = leak_s[q], 0.0
            never_before_s = tau / (1 + FAR * jitter)
            log_rate = math.log(rate_hz[i])
            for k in range(starts[i], starts[i + 1]):
                age = age_s[k]
                total -= rate_hz[i] * age
                if age < never_before_s:
                    total += log_rate if on[k] else 0.0
                    continue
                z = (tau / age - 1) / jitter
                survival = max(0.5 * math.erfc(-z / math.sqrt(2.0)), 1e-12)
                density = math.exp(-z * z / 2) / math.sqrt(2 * math.pi) * tau / (age * age * jitter)
                total += math.log(rate_hz[i] * survival + density) if on[k] else math.log(survival)
            values[i, q] = total
    return values
