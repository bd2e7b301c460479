"""The leak from increments that drift with the duration of their interval."""

import numpy as np
import pytest

from polarnet.characterization.known_light import Increments
from polarnet.characterization.leak import leak_drift, thresholds_without_leak

PIXELS, EACH = 800, 200


def constructed(leak_hz: float, noise: float, shots: float = 0.0) -> Increments:
    """Intervals of 0.1 s on average with thresholds of 0.3 (ON) and 0.15 (OFF)."""
    generator = np.random.default_rng(1)
    pixel, n = np.repeat(np.arange(PIXELS), EACH), PIXELS * EACH
    on, duration_s = generator.random(n) < 0.5, generator.exponential(0.1, n)
    leaked = leak_hz * 0.3 * duration_s
    increment = np.where(on, 0.3 - leaked, 0.15 + leaked) + noise * 0.3 * generator.standard_normal(n)
    shot = generator.random(n) < 1 - np.exp(-shots * duration_s)
    increment[shot] *= generator.uniform(-1, 1, shot.sum())
    return Increments(increment, duration_s, pixel, on, np.arange(n) // 8)


def test_a_leak_that_moves_long_intervals_beyond_the_noise_is_found():
    """A second moves an increment by 0.3 thresholds, fifteen standard deviations."""
    assert leak_drift(constructed(0.3, noise=0.02), PIXELS, 0.0).value == pytest.approx(0.3, rel=0.02)


def test_shot_noise_a_hundred_times_the_leak_moves_the_leak_by_less_than_its_tenth():
    estimate = leak_drift(constructed(0.03, noise=0.02, shots=3.0), PIXELS, 0.0)
    assert estimate.value == pytest.approx(0.03, rel=0.1)


def test_the_leak_is_the_median_of_pixels_whose_mean_drift_is_larger():
    """10^z, z of deviation 0.1, has the mean exp((0.1 ln 10)^2 / 2) = 1.0269 and the median 1."""
    mean, median = (leak_drift(constructed(0.1, noise=0.02), PIXELS, spread).value for spread in (0.0, 0.1))
    assert mean / median == pytest.approx(1.0269, abs=1e-4)


def test_increments_that_do_not_drift_have_no_leak():
    assert leak_drift(constructed(-0.05, noise=0.02), PIXELS, 0.1) is None


def test_thresholds_are_those_without_the_leak():
    thresholds = thresholds_without_leak(constructed(0.3, noise=0.02), 0.3, PIXELS)
    assert np.median(thresholds.on.threshold) == pytest.approx(0.3, rel=0.003)
    assert np.median(thresholds.off.threshold) == pytest.approx(0.15, rel=0.003)
