"""The leak, and the thresholds without it, from increments under known light.

With a leak of r hertz, an increment of duration T is (1 - r T) ON thresholds, or one OFF threshold plus r T ON
thresholds.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from polarnet.characterization.estimates import GROUPS, Estimate
from polarnet.characterization.known_light import Increments
from polarnet.characterization.thresholds import PixelThresholds, pixel_thresholds

LEAKED = 0.25  # of a threshold: an interval in which the leak alone makes more is not used
ROUNDS = 4  # each finds three quarters of the leak that is still missing (normal errors within NEAR)
NEAR = 2.0  # standard deviations from the threshold: the shift by shot noise within it grows with its square
MIN_NEAR = 0.02  # the same, relative to the threshold


class PolarityThresholds(NamedTuple):
    """Thresholds of both polarities."""

    on: PixelThresholds
    off: PixelThresholds

    @property
    def every_on(self) -> Float64[np.ndarray, " pixels"]:
        """ON thresholds, with the median for pixels that have none."""
        threshold = self.on.threshold
        return np.where(np.isfinite(threshold), threshold, np.nanmedian(threshold))


def thresholds_without_leak(data: Increments, leak_hz: float, pixels: int) -> PolarityThresholds:
    """Thresholds of both polarities, with the leak taken out of the increments."""
    first = _thresholds(data, data.increment, 0.0, pixels)
    return _thresholds(data, _without_leak(data, leak_hz, first), leak_hz, pixels) if leak_hz > 0 else first


def leak_drift(data: Increments, pixels: int, spread_decades: float) -> Estimate | None:
    """Median leak of the pixels in Hz, from increments that shrink (ON) or grow (OFF) with their duration.

    Shot noise that ends an interval shortens both kinds, so it nearly cancels in half the difference of their slopes.
    Only increments near a threshold count. The leak moves those of long intervals away from it, so the leak found so
    far is removed from the increments and the rest is estimated again, in `ROUNDS` rounds. None if increments do not
    drift. `spread_decades` is the log-normal spread of the leak between pixels, by which its mean exceeds the median.
    """
    leaks, leak = np.zeros(GROUPS), 0.0
    thresholds = _thresholds(data, data.increment, 0.0, pixels)
    for _ in range(ROUNDS):
        increment = _without_leak(data, leak, thresholds)
        thresholds = _thresholds(data, increment, leak, pixels)
        leaks = leak + _remaining_drift(data, increment, leak, thresholds)
        leak = float(leaks.mean())
        if leak <= 0:
            return None
    mean_over_median = math.exp(0.5 * (math.log(10) * spread_decades) ** 2)
    error = float(leaks.std(ddof=1)) / math.sqrt(GROUPS)
    return Estimate(leak / mean_over_median, error / mean_over_median, "drift of increments under known light")


def _without_leak(data: Increments, leak_hz: float, thresholds: PolarityThresholds) -> Float64[np.ndarray, " n"]:
    """Increments plus (ON) or minus (OFF) the leak of their interval, a part of the pixel's ON threshold."""
    leaked = leak_hz * data.duration_s * thresholds.every_on[data.pixel]
    return data.increment + np.where(data.on, leaked, -leaked)


def _thresholds(
    data: Increments, increment: Float64[np.ndarray, " n"], leak_hz: float, pixels: int
) -> PolarityThresholds:
    short = leak_hz * data.duration_s < LEAKED
    return PolarityThresholds(
        *(
            pixel_thresholds(increment[chosen], data.pixel[chosen], data.block[chosen], pixels)
            for chosen in (data.on & short, ~data.on & short)
        )
    )


def _remaining_drift(
    data: Increments, increment: Float64[np.ndarray, " n"], leak_hz: float, thresholds: PolarityThresholds
) -> Float64[np.ndarray, " groups"]:
    """Leak that is left in `increment`, from the slopes over the duration within each pixel; one for each group."""
    slopes, unit = [], thresholds.every_on
    for of, (threshold, _, scale) in zip((data.on, ~data.on), thresholds, strict=True):
        error = increment / threshold[data.pixel] - 1
        near = of & (np.abs(error) < max(NEAR * scale, MIN_NEAR)) & (leak_hz * data.duration_s < LEAKED)
        pixel = data.pixel[near]
        x = _centred(data.duration_s[near], pixel, len(unit))
        y = _centred(increment[near] / unit[pixel], pixel, len(unit))
        group = pixel % GROUPS
        slopes.append(np.bincount(group, x * y, GROUPS) / np.maximum(np.bincount(group, x * x, GROUPS), 1e-12))
    return 0.5 * (slopes[1] - slopes[0])


def _centred(values, pixel, pixels: int) -> Float64[np.ndarray, " n"]:
    """Values less their mean over the pixel."""
    mean = np.bincount(pixel, values, pixels) / np.maximum(np.bincount(pixel, minlength=pixels), 1)
    return values - mean[pixel]
