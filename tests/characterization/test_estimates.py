"""Noise, flicker and thresholds of a sensor, estimated from constructed events."""

import dataclasses
import math

import numpy as np
import pytest
from event_fixtures import events_of

from polarnet.characterization.flicker import Flicker, Increments, flicker_cycle, thresholds_without_leak, undisturbed
from polarnet.characterization.noise import (
    estimate_noise,
    hot_under_constant_light,
    leak_of,
    mean_inverse,
    nominal_shot_noise_hz,
    rate_swing,
)
from polarnet.characterization.thresholds import deviation, pixel_thresholds
from polarnet.events.intervals import PixelEvents, by_pixel, intervals_of
from polarnet.simulation.presets import SENSORS

PIXELS = 600
NO_HOT = np.zeros(PIXELS, bool)


def recorded(times_s, on) -> PixelEvents:
    """Events of pixels 0, 1, ... from lists of times and polarities."""
    pixel = np.repeat(np.arange(len(times_s)), [len(t) for t in times_s])
    return PixelEvents(pixel, 1e6 * np.concatenate(times_s), np.concatenate(on), len(times_s))


def test_shot_noise_restarts_a_pixel_before_it_leaks_and_is_referred_to_a_dark_pixel_of_nominal_threshold():
    """Shot noise of 0.5 Hz lets exp(-2) of the leaks after 4 s pass, each once in a cycle of (1 - exp(-2)) / 0.5 s."""
    pixel = dataclasses.replace(SENSORS["default"], noise_rate_cov_decades=0.0, leak_jitter=0.0)
    assert leak_of(0.5 * math.exp(-2) / (1 - math.exp(-2)), 0.5, pixel) == pytest.approx(0.25)
    assert leak_of(0.25, 0.0, pixel) == pytest.approx(0.25, rel=1e-4)
    # At 80 DN the rate is 1 - 0.75 x 100 / 275 = 8 / 11 of the nominal one.
    assert nominal_shot_noise_hz(0.8, 80.0, 0.0, 0.0) == pytest.approx(1.1)
    assert nominal_shot_noise_hz(0.8, 80.0, 0.1, 0.1) == pytest.approx(1.1 / mean_inverse(0.1))


def test_a_slow_pixel_is_hot_above_ten_times_its_neighbours_events_and_too_few_are_refused():
    rows = [(k, x, y, 1) for y in range(8) for x in range(8) for k in range(31 if (x, y) == (3, 4) else 3)]
    assert np.flatnonzero(hot_under_constant_light(events_of(sorted(rows), 8, 8))).tolist() == [8 * 4 + 3]
    with pytest.raises(ValueError, match="record for longer"):
        estimate_noise(recorded([np.arange(5.0)], [np.ones(5, bool)]), NO_HOT[:1], SENSORS["default"])
    with pytest.raises(ValueError, match="expected pixels that are not hot, got 1 hot ones"):
        estimate_noise(recorded([np.arange(200.0)], [np.ones(200, bool)]), ~NO_HOT[:1], SENSORS["default"])


def test_the_rate_of_a_poisson_process_does_not_swing_and_that_of_a_passing_edge_does():
    generator = np.random.default_rng(5)
    steady = generator.uniform(0, 1e6, 2000)
    assert rate_swing(steady, steady) < 0.06
    edge = np.concatenate([steady, generator.uniform(4e5, 5e5, 2000)])  # two of 20 parts have eleven times the rate
    assert rate_swing(edge, edge) == pytest.approx(1.54, abs=0.1)  # 100 and 1,100: mean 200, deviation 308


def constructed(deviation_on: float, noise: float, shots: float, seed: int = 0, pixels: int = 2000, each: int = 40):
    """Increments of pixels with known thresholds around 0.2, some of them cut short by shot noise."""
    generator = np.random.default_rng(seed)
    threshold = 0.2 + deviation_on * generator.standard_normal(pixels)
    pixel = np.repeat(np.arange(pixels), each)
    increment = threshold[pixel] * (1 + noise * generator.standard_normal(len(pixel)))
    cut = generator.random(len(pixel)) < shots
    increment[cut] *= generator.uniform(-1, 1, cut.sum())
    return threshold, pixel_thresholds(increment, pixel, np.arange(len(pixel)) // 8, pixels)


def test_intervals_lie_between_events_of_one_pixel_and_not_at_its_refractory_period():
    events = by_pixel(events_of([(10, 0, 0, 1), (20, 1, 0, 1), (40, 0, 0, -1), (50, 1, 0, 1)], 1, 2))
    intervals = intervals_of(events)
    columns = (intervals.duration_us.tolist(), intervals.pixel.tolist(), intervals.on.tolist())
    assert columns == ([30, 30], [0, 1], [False, True])
    events = by_pixel(events_of([(t, 0, 0, 1) for t in (0, 5000, 5500, 9000, 12000)], 1, 1))
    assert undisturbed(intervals_of(events), 500.0).duration_us.tolist() == [5000, 3000]


def test_thresholds_are_free_of_estimation_noise_and_nearly_of_shot_noise():
    """Noise of 15 % over 40 increments widens the estimates to hypot(0.01, 0.2 x 0.15 / sqrt(40)) = 0.0111."""
    _, estimate = constructed(0.01, noise=0.15, shots=0.0, each=40)
    assert np.nanstd(estimate.threshold) > 0.0107
    assert deviation(estimate) == pytest.approx(0.01, rel=0.05)
    threshold, estimate = constructed(0.03, noise=0.02, shots=0.33)
    assert np.nanmean(estimate.threshold / threshold) == pytest.approx(1, abs=0.02)


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


@pytest.mark.parametrize(
    ("level", "changes", "response"),
    [
        (100.0, {}, np.log),
        (10.0, {}, lambda dn: dn * math.log(20) / 20),
        (10.0, {"knee_dn": 2.72}, np.log),
        (10.0, {"dark_dn": 5.0}, lambda dn: np.log(dn + 5)),
    ],
)
def test_without_a_photoreceptor_the_cycle_is_the_response_of_the_sensor(level, changes, response):
    flicker = Flicker(level, 0.5, 10.0)
    cycle = flicker_cycle(flicker, dataclasses.replace(SENSORS["default"], **changes), 0.0)
    assert cycle == pytest.approx(response(flicker.light(np.linspace(0, 2 * math.pi, len(cycle)))), abs=1e-5)


def test_a_flicker_at_the_bandwidth_of_its_level_loses_a_factor_of_root_two():
    flickers = (Flicker(127.5, 0.05, frequency_hz) for frequency_hz in (0.1, 147.5))
    slow, fast = (flicker_cycle(flicker, SENSORS["default"], 275.0) for flicker in flickers)
    assert np.ptp(slow) == pytest.approx(math.log(1.05 / 0.95), rel=1e-3)
    assert np.ptp(fast) == pytest.approx(np.ptp(slow) / math.sqrt(2), rel=1e-2)
    assert fast[0] == pytest.approx(fast[-1])
    assert 2 * math.pi * fast.argmax() / (len(fast) - 1) == pytest.approx(0.75 * math.pi, abs=0.05)  # 45 degrees late


@pytest.mark.parametrize(
    ("values", "word"), [((127.5, 1.2, 10.0), "contrast"), ((127.5, 0.5, 0.0), "Hz"), ((200.0, 0.5, 10.0), "lower the")]
)
def test_impossible_flicker_is_refused(values, word):
    with pytest.raises(ValueError, match=word):
        Flicker(*values)
