"""Contrast thresholds of pixels from the increments between their events, and their spread over the pixels.

A pixel's threshold is the robust mean of its increments around their most frequent value.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

MIN_INTERVALS = 6  # intervals of one polarity that a pixel needs for a threshold
FIRST_SCALES = (0.4, 0.25, 0.15, 0.1)  # widths of the robust mean while it approaches the most frequent value
REFINEMENTS = 12
MIN_SCALE = 0.003  # relative: 1 us and float32 in a simulation; cameras are far above
MAX_SCALE = 0.15
TUKEY = 4.685  # width of the biweight in standard deviations: 95 % efficiency for normal errors


class Estimate(NamedTuple):
    """A parameter of the sensor."""

    value: float
    error: float
    """Standard error."""
    source: str  # recordings and events behind the estimate, in words


class PixelThresholds(NamedTuple):
    """Thresholds of one polarity."""

    threshold: Float64[np.ndarray, " pixels"]
    """Natural-log intensity; NaN for pixels with too few intervals."""
    halves: Float64[np.ndarray, "2 pixels"]
    """The same from each half of a pixel's intervals, taken in alternate blocks."""
    scale: float
    """Relative standard deviation of increments around their pixel's threshold."""


def pixel_thresholds(
    increment: Float64[np.ndarray, " n"], pixel: Int64[np.ndarray, " n"], block: Int64[np.ndarray, " n"], pixels: int
) -> PixelThresholds:
    """Thresholds from `increment`, positive in the direction of the events' polarity.

    `block` numbers stretches of time; even blocks make one half of the data, odd blocks the other. ValueError if no
    increment is positive.
    """
    positive = increment > 0.01
    increment, pixel, block = increment[positive], pixel[positive], block[positive]
    if len(increment) == 0:
        raise ValueError("expected events that follow the light, got none; check the frequency of the flicker")
    start = np.full(pixels, _most_frequent(increment))
    near = np.abs(np.log(increment / start[0])) < 0.9
    start = _medians(increment[near], pixel[near], start)
    threshold, scale = start, FIRST_SCALES[0]
    for scale in FIRST_SCALES:
        threshold = _robust_means(increment, pixel, threshold, scale)
    for _ in range(REFINEMENTS):
        scale = _relative_scale(increment, pixel, threshold)
        threshold = _robust_means(increment, pixel, threshold, scale)
    enough = np.bincount(pixel[_near(increment, pixel, threshold, scale)], minlength=pixels) >= MIN_INTERVALS
    halves = []
    for parity in (0, 1):
        half = block % 2 == parity
        estimate = threshold
        for _ in range(REFINEMENTS // 2):
            estimate = _robust_means(increment[half], pixel[half], estimate, scale)
        inliers = _near(increment[half], pixel[half], estimate, scale)
        filled = np.bincount(pixel[half][inliers], minlength=pixels) >= MIN_INTERVALS // 2
        halves.append(np.where(filled & enough, estimate, np.nan))
    return PixelThresholds(np.where(enough, threshold, np.nan), np.stack(halves), scale)


def _most_frequent(increment) -> float:
    """Most frequent increment, from a histogram of logarithms in bins of 0.1, each with its two neighbours."""
    counts, edges = np.histogram(np.log(increment), np.arange(np.log(0.01), np.log(8.0), 0.1))
    smooth = np.convolve(counts, np.ones(3), "same")
    return float(np.exp(edges[np.argmax(smooth)] + 0.05))


def _relative_scale(increment, pixel, threshold) -> float:
    """Standard deviation of relative increments around 1, from the upper side, where shot noise does not reach."""
    above = increment / threshold[pixel] - 1
    above = above[(above >= 0) & (above < 0.5)]
    return float(np.clip(1.4826 * np.median(above), MIN_SCALE, MAX_SCALE)) if len(above) else MAX_SCALE


def covariance(a: Float64[np.ndarray, " n"], b: Float64[np.ndarray, " n"]) -> float:
    """Covariance over the pixels that have both values."""
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.cov(a[both], b[both])[0, 1]) if both.sum() > 2 else float("nan")


def deviation(thresholds: PixelThresholds) -> float:
    """Standard deviation between pixels without estimation noise, by the covariance of the two halves."""
    return max(covariance(*thresholds.halves), 0.0) ** 0.5


def correlation(on: PixelThresholds, off: PixelThresholds) -> float:
    """Correlation of ON and OFF thresholds; each half of one with the other half of the other, so noise drops out."""
    crossed = 0.5 * (covariance(on.halves[0], off.halves[1]) + covariance(on.halves[1], off.halves[0]))
    scale = deviation(on) * deviation(off)
    return float(np.clip(crossed / scale, -1, 1)) if scale > 0 else float("nan")


def misfit(increment, pixel, threshold) -> float:
    """Share of increments far from the threshold of their pixel, 0 to 1; small deviations count little."""
    squared = np.minimum(((increment / threshold[pixel] - 1) / MAX_SCALE) ** 2, 1.0)
    return float(np.mean(squared * (3 - 3 * squared + squared**2)))


def _near(increment, pixel, threshold, scale) -> Bool[np.ndarray, " n"]:
    return np.abs(increment / threshold[pixel] - 1) < 3 * scale


def _robust_means(increment, pixel, threshold, scale) -> Float64[np.ndarray, " pixels"]:
    """One step of Tukey's biweight mean of each pixel, of relative width `scale`; unchanged without increments."""
    u = (increment / threshold[pixel] - 1) / (TUKEY * scale)
    weight = np.where(np.abs(u) < 1, (1 - u * u) ** 2, 0.0)
    total = np.bincount(pixel, weight, len(threshold))
    moved = np.bincount(pixel, weight * increment, len(threshold)) / np.maximum(total, 1e-12)
    return np.where(total > 0, moved, threshold)


def _medians(values, pixel, fallback) -> Float64[np.ndarray, " pixels"]:
    order = np.lexsort((values, pixel))
    starts = np.searchsorted(pixel[order], np.arange(len(fallback) + 1))
    counts = np.diff(starts)
    middle = np.minimum(starts[:-1] + counts // 2, max(len(values) - 1, 0))
    return np.where(counts > 0, values[order][middle], fallback)
