"""Noise under constant light: Poisson rates, a regular leak, hot pixels."""

import dataclasses
import math

import numpy as np
import pytest
from event_fixtures import events_of

from polarnet.characterization.intervals import PixelEvents
from polarnet.characterization.noise import (
    estimate_noise,
    hot_under_constant_light,
    leak_of,
    mean_inverse,
    nominal_shot_noise_hz,
    rate_swing,
)
from polarnet.simulation.presets import SENSORS

PIXELS, DURATION_S = 600, 60.0
NO_HOT = np.zeros(PIXELS, bool)


def recorded(times_s, on) -> PixelEvents:
    """Events of pixels 0, 1, ... from lists of times and polarities."""
    pixel = np.repeat(np.arange(len(times_s)), [len(t) for t in times_s])
    return PixelEvents(pixel, 1e6 * np.concatenate(times_s), np.concatenate(on), len(times_s))


def poisson(rate_hz: float, generator) -> tuple[list, list]:
    times = [np.sort(generator.uniform(0, DURATION_S, generator.poisson(rate_hz * DURATION_S))) for _ in range(PIXELS)]
    return times, [generator.random(len(t)) < 0.5 for t in times]


def test_a_poisson_process_of_2_hz_gives_1_hz_of_each_polarity_and_no_certain_leak():
    noise = estimate_noise(recorded(*poisson(2.0, np.random.default_rng(3))), NO_HOT, SENSORS["default"])
    assert noise.shot_off_hz == pytest.approx(1.0, abs=0.03)  # 36,000 events: standard error 0.005
    assert noise.shot_on_hz == pytest.approx(1.0, abs=0.03)
    assert noise.leak is None or noise.leak.error > 0.05 * noise.leak.value


def test_on_events_about_every_4_seconds_are_a_leak_of_a_quarter_hertz():
    pixel = dataclasses.replace(SENSORS["default"], noise_rate_cov_decades=0.0)
    generator = np.random.default_rng(4)
    ages = 4 / (1 - 0.1 * generator.standard_normal((PIXELS, 30)))
    times = [t[t < DURATION_S] for t in np.cumsum(ages, axis=1) - generator.uniform(0, 4, (PIXELS, 1))]
    noise = estimate_noise(recorded(times, [np.ones(len(t), bool) for t in times]), NO_HOT, pixel)
    assert noise.leak.value == pytest.approx(0.25, rel=0.02)
    assert noise.shot_off_hz == 0
    assert noise.leak.error < 0.01


def test_shot_noise_restarts_a_pixel_before_it_leaks():
    """Shot noise of 0.5 Hz lets exp(-2) of the leaks after 4 s pass, each once in a cycle of (1 - exp(-2)) / 0.5 s."""
    pixel = dataclasses.replace(SENSORS["default"], noise_rate_cov_decades=0.0, leak_jitter=0.0)
    assert leak_of(0.5 * math.exp(-2) / (1 - math.exp(-2)), 0.5, pixel) == pytest.approx(0.25)
    assert leak_of(0.25, 0.0, pixel) == pytest.approx(0.25, rel=1e-4)


def test_shot_noise_is_referred_to_a_dark_pixel_of_nominal_threshold():
    """At 80 DN the rate is 1 - 0.75 x 100 / 275 = 8 / 11 of the nominal one."""
    assert nominal_shot_noise_hz(0.8, 80.0, 0.0, 0.0) == pytest.approx(1.1)
    assert nominal_shot_noise_hz(0.8, 80.0, 0.1, 0.1) == pytest.approx(1.1 / mean_inverse(0.1))


def test_the_mean_inverse_exceeds_1_by_the_squared_deviation():
    assert mean_inverse(0.1) == pytest.approx(1 + 0.1**2 + 3 * 0.1**4, abs=2e-5)


def test_a_slow_pixel_is_hot_under_constant_light_above_ten_times_its_neighbours_events():
    rows = [(k, x, y, 1) for y in range(8) for x in range(8) for k in range(31 if (x, y) == (3, 4) else 3)]
    assert np.flatnonzero(hot_under_constant_light(events_of(sorted(rows), 8, 8))).tolist() == [8 * 4 + 3]


def test_too_few_events_are_refused():
    with pytest.raises(ValueError, match="record for longer"):
        estimate_noise(recorded([np.arange(5.0)], [np.ones(5, bool)]), NO_HOT[:1], SENSORS["default"])


def test_the_rate_of_a_poisson_process_does_not_swing_and_that_of_a_passing_edge_does():
    generator = np.random.default_rng(5)
    steady = generator.uniform(0, 1e6, 2000)
    assert rate_swing(steady, steady) < 0.06
    edge = np.concatenate([steady, generator.uniform(4e5, 5e5, 2000)])  # two of 20 parts have eleven times the rate
    assert rate_swing(edge, edge) == pytest.approx(1.54, abs=0.1)  # 100 and 1,100: mean 200, deviation 308
