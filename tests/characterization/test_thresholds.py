"""Thresholds from increments: free of estimation noise and of shot noise."""

import numpy as np
import pytest
from event_fixtures import events_of

from polarnet.characterization.flicker import (
    Increments,
    correlation,
    deviation,
    pixel_thresholds,
    thresholds_without_leak,
)
from polarnet.characterization.intervals import by_pixel, intervals_of, undisturbed


def constructed(deviation_on: float, noise: float, shots: float, seed: int = 0, pixels: int = 2000, each: int = 40):
    """Increments of pixels with known thresholds around 0.2, some of them cut short by shot noise."""
    generator = np.random.default_rng(seed)
    threshold = 0.2 + deviation_on * generator.standard_normal(pixels)
    pixel = np.repeat(np.arange(pixels), each)
    increment = threshold[pixel] * (1 + noise * generator.standard_normal(len(pixel)))
    cut = generator.random(len(pixel)) < shots
    increment[cut] *= generator.uniform(-1, 1, cut.sum())
    return threshold, pixel_thresholds(increment, pixel, np.arange(len(pixel)) // 8, pixels)


def test_intervals_start_and_end_at_events_of_the_same_pixel():
    events = by_pixel(events_of([(10, 0, 0, 1), (20, 1, 0, 1), (40, 0, 0, -1), (50, 1, 0, 1)], 1, 2))
    intervals = intervals_of(events)
    columns = (intervals.duration_us.tolist(), intervals.pixel.tolist(), intervals.on.tolist())
    assert columns == ([30, 30], [0, 1], [False, True])


def test_an_interval_at_the_refractory_period_and_the_one_after_it_do_not_count():
    events = by_pixel(events_of([(t, 0, 0, 1) for t in (0, 5000, 5500, 9000, 12000)], 1, 1))
    assert undisturbed(intervals_of(events), 500.0).duration_us.tolist() == [5000, 3000]


def test_each_pixel_gets_its_own_threshold():
    threshold, estimate = constructed(0.04, noise=0.0, shots=0.0)
    assert estimate.threshold == pytest.approx(threshold)


def test_halves_remove_estimation_noise_from_the_deviation():
    """Noise of 15 % over 40 increments widens the estimates to hypot(0.01, 0.2 x 0.15 / sqrt(40)) = 0.0111."""
    _, estimate = constructed(0.01, noise=0.15, shots=0.0, each=40)
    assert np.nanstd(estimate.threshold) > 0.0107
    assert deviation(estimate) == pytest.approx(0.01, rel=0.05)


def test_shot_noise_that_ends_a_third_of_the_intervals_moves_thresholds_by_less_than_2_percent():
    threshold, estimate = constructed(0.03, noise=0.02, shots=0.33)
    assert np.nanmean(estimate.threshold / threshold) == pytest.approx(1, abs=0.02)


def test_equal_maps_correlate_fully_and_independent_ones_do_not():
    _, on = constructed(0.03, noise=0.1, shots=0.0, seed=1)
    _, off = constructed(0.03, noise=0.1, shots=0.0, seed=2)
    assert correlation(on, on) == pytest.approx(1, abs=0.02)
    assert correlation(on, off) == pytest.approx(0, abs=0.07)


def test_events_that_never_follow_the_light_are_refused():
    with pytest.raises(ValueError, match="frequency of the flicker"):
        pixel_thresholds(np.full(100, -0.2), np.zeros(100, np.int64), np.zeros(100, np.int64), 1)


def test_thresholds_are_those_without_the_leak():
    """A leak of 0.3 Hz over a second moves an increment by 0.3 ON thresholds, fifteen standard deviations."""
    generator = np.random.default_rng(1)
    pixel, n = np.repeat(np.arange(400), 200), 80_000
    on, duration_s = generator.random(n) < 0.5, generator.exponential(0.1, n)
    leaked = 0.3 * 0.3 * duration_s
    increment = np.where(on, 0.3 - leaked, 0.15 + leaked) + 0.006 * generator.standard_normal(n)
    on_pixels, off_pixels = thresholds_without_leak(
        Increments(increment, duration_s, pixel, on, np.arange(n) // 8), 0.3, 400
    )
    assert np.median(on_pixels.threshold) == pytest.approx(0.3, rel=0.003)
    assert np.median(off_pixels.threshold) == pytest.approx(0.15, rel=0.003)
