"""Leak, shot noise and hot pixels of a sensor under constant light.

OFF events under constant light are shot noise, a Poisson process. ON events are shot noise or the leak, which fires a
pixel at about the same time after each of its events: at age T = tau / (1 - jitter z) with z normal, where 1 / tau is
log-normal over the pixels. Both processes start anew with each event of the pixel.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import brentq

from polarnet.characterization.thresholds import Estimate
from polarnet.events.intervals import PixelEvents, chosen_pixels, intervals_of
from polarnet.events.stream import Events
from polarnet.recordings.noise import event_counts, hot_pixels
from polarnet.simulation.pixels.physics import PixelConfig, shot_noise_fraction

NOISE_HOT_FACTOR = 10.0  # of `hot_pixels` under constant light: thresholds alone make no pixel so busy
NODES = np.linspace(-3, 3, 61)  # standard deviations of a normal distribution
NODE_WEIGHTS = np.exp(-(NODES**2) / 2) / np.exp(-(NODES**2) / 2).sum()
YOUNG = 0.4  # ages below this part of the leak interval see shot noise alone
MIN_SHOT_HZ = 1e-6
SWING_PARTS = 20


class Noise(NamedTuple):
    """Noise of a sensor under constant light, events per pixel and second."""

    leak: Estimate | None
    """Median over the pixels; None without more ON events than shot noise has."""
    shot_hz: float
    """Shot noise, ON and OFF; mean over the pixels."""
    shot_error_hz: float
    """Its standard error."""
    hot: Bool[np.ndarray, " pixels"]
    hot_rates_hz: Float64[np.ndarray, " hot"]
    """Events per second of each hot pixel."""
    duration_s: float
    swing: float
    """Relative standard deviation of the OFF rate over 20 parts of the time, beyond chance; 0 under constant light."""


def hot_under_constant_light(events: Events) -> Bool[np.ndarray, " pixels"]:
    """Hot pixels, however slow: those with more than ten times the events of the pixels around them."""
    return hot_pixels(event_counts(events), 1.0, NOISE_HOT_FACTOR, min_hz=0.0).ravel()


def estimate_noise(events: PixelEvents, hot: Bool[np.ndarray, " pixels"], pixel: PixelConfig) -> Noise:
    """Noise from a recording of constant light, with its hot pixels.

    Spread and jitter of the leak are those of `pixel`. ValueError with fewer than 100 events, or if all pixels are hot.
    """
    if len(events.t_us) < 100:
        raise ValueError(
            f"expected at least 100 events under constant light, got {len(events.t_us)}; record for longer"
        )
    counts = np.bincount(events.pixel, minlength=events.pixels)
    good = int((~hot).sum())
    if not good:
        raise ValueError(f"expected pixels that are not hot, got {len(hot)} hot ones; record a uniform, constant light")
    duration_s = float(np.ptp(events.t_us)) * 1e-6
    exposure_s = good * duration_s
    ordinary = chosen_pixels(events, ~hot)
    off = np.bincount(ordinary.pixel[~ordinary.on], minlength=events.pixels)[~hot] / duration_s
    shot_off, shot_on, leak = float(off.mean()), float(ordinary.on.sum()) / exposure_s, None
    if shot_on > shot_off:
        young_s = YOUNG / leak_of(shot_on - shot_off, 2 * shot_off, pixel)
        leaks_hz, error_hz = _leaks(ordinary, young_s)
        if leaks_hz > 0:
            shot_on = max(shot_on - leaks_hz, 0.0)
            value, more = (leak_of(leaks_hz + error, shot_on + shot_off, pixel) for error in (0.0, error_hz))
            leak = Estimate(value, more - value, "ON events under constant light beyond shot noise")
    poisson = math.sqrt((shot_on + shot_off) / exposure_s)
    return Noise(
        leak=leak,
        shot_hz=shot_on + shot_off,
        shot_error_hz=max(poisson, float(off.std()) / math.sqrt(good)),
        hot=hot,
        hot_rates_hz=counts[hot] / duration_s,
        duration_s=duration_s,
        swing=rate_swing(ordinary.t_us[~ordinary.on], events.t_us),
    )


def leak_of(leaks_hz: float, shot_hz: float, pixel: PixelConfig) -> float:
    """Median leak rate (Hz) of pixels that leak `leaks_hz` > 0 times a second between `shot_hz` events of shot noise.

    A pixel leaks after an event with the probability q = <exp(-shot_hz T)> that no shot noise comes before T. Its leaks
    are then shot_hz q / (1 - q) a second.
    """
    shot_hz = max(shot_hz, MIN_SHOT_HZ)
    relative = 10 ** (-pixel.noise_rate_cov_decades * NODES[:, None]) / np.maximum(1 - pixel.leak_jitter * NODES, 0.1)

    def beyond(log_leak: float) -> float:
        late = -np.expm1(-shot_hz * math.exp(-log_leak) * relative) @ NODE_WEIGHTS  # 1 - q
        return float((shot_hz * (1 - late) / late) @ NODE_WEIGHTS) - leaks_hz

    middle = math.log(shot_hz / math.log1p(shot_hz / leaks_hz))  # of pixels that are all the same
    return math.exp(brentq(beyond, middle - 5, middle + 5))


def _leaks(events: PixelEvents, young_s: float) -> tuple[float, float]:
    """Rate of leaks and its standard error, from the ON events that ON shot noise does not explain.

    No pixel leaks before `young_s`, so that the rate of shot noise is that of young ON events.

    By the renewal theorem a pixel has (1 - v) / 2 events fewer in the time after its first event than in as long a time
    at large, for intervals of squared coefficient of variation v.
    """
    intervals = intervals_of(events)
    last = np.append(events.pixel[1:] != events.pixel[:-1], True)
    ages_s = np.append(intervals.duration_us, events.t_us.max() - events.t_us[last]) * 1e-6
    young = int((intervals.on & (intervals.duration_us < 1e6 * young_s)).sum())
    old = int(intervals.on.sum()) - young
    young_exposure_s = float(np.minimum(ages_s, young_s).sum())
    odds = float(ages_s.sum()) / young_exposure_s - 1  # old shot noise for each young one
    variation = float(intervals.duration_us.var() / intervals.duration_us.mean() ** 2)
    share = (1 + 0.5 * (1 - variation) * last.sum() / len(intervals.on)) / float(ages_s.sum())
    return share * (old - odds * young), share * math.sqrt(old + odds**2 * young)


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
