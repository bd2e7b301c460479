"""Lags between events and pictures of the same light, where both are known exactly."""

import numpy as np
import pytest

from polarnet.captures.alignment import agreement, best_lag, changes, logarithms, spread, steps, thresholds

HEIGHT, WIDTH, THRESHOLD_ON, THRESHOLD_OFF = 4, 5, 0.2, 0.25
PERIOD_US = 16_667


def log_light(t_s, pixel):
    """Smooth, different in every pixel."""
    return 6.6 + np.sin(2 * np.pi * (3 + pixel / 7) * t_s + pixel) + 0.4 * np.sin(2 * np.pi * 7.3 * t_s + 2 * pixel)


@pytest.fixture(scope="module")
def events(make_events):
    """Events of ideal pixels with larger OFF than ON thresholds."""
    t_us = np.arange(0, 1_000_000, 20)
    rows = []
    for pixel in range(HEIGHT * WIDTH):
        light = log_light(t_us * 1e-6, pixel)
        reference = light[0]
        for t, level in zip(t_us.tolist(), light.tolist(), strict=True):
            if level >= reference + THRESHOLD_ON:
                reference += THRESHOLD_ON
                rows.append((t, pixel % WIDTH, pixel // WIDTH, 1))
            elif level <= reference - THRESHOLD_OFF:
                reference -= THRESHOLD_OFF
                rows.append((t, pixel % WIDTH, pixel // WIDTH, -1))
    return make_events(sorted(rows), HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def pictures():
    """Times and pictures of 12 bits of the same light."""
    t_us = np.arange(0, 1_000_000, PERIOD_US)
    light = np.exp(np.stack([log_light(t_us * 1e-6, pixel) for pixel in range(HEIGHT * WIDTH)], axis=1))
    return t_us, np.rint(light).astype(np.uint16).reshape(-1, HEIGHT, WIDTH)


def of(events):
    return steps(events, (0, 0), (HEIGHT, WIDTH), -(10**9), 10**9)


def test_each_step_lies_between_two_events_of_one_pixel(make_events):
    rows = [(1, 0, 0, 1), (2, 1, 0, -1), (5, 0, 0, 1), (9, 1, 0, 1), (9, 0, 0, -1)]
    pairs = steps(make_events(rows, 1, 2), (0, 0), (1, 2), 0, 9)
    assert pairs.before_us.tolist() == [1]  # those that end at 9 us are not before the stop
    assert (pairs.after_us.tolist(), pairs.pixel.tolist(), pairs.polarity.tolist()) == ([5], [0], [1])


@pytest.mark.parametrize("shift_us", [-31_400, -700, 0, 12_345])
def test_the_lag_of_pictures_is_found_much_finer_than_a_picture_and_the_thresholds_too(events, pictures, shift_us):
    t_us, values = pictures
    lag = best_lag(of(events), t_us + shift_us, logarithms(values), 50_000)
    assert lag.lag_us == pytest.approx(shift_us, abs=150)
    assert lag.agreement > 0.97
    assert lag.thresholds == pytest.approx((THRESHOLD_ON, THRESHOLD_OFF), rel=0.05)


def test_noise_of_the_pictures_does_not_move_the_lag(events, pictures):
    t_us, values = pictures
    noise = np.random.default_rng(0).normal(0, 0.03, values.shape)
    noisy = np.rint(values * np.exp(noise)).astype(np.uint16)
    assert best_lag(of(events), t_us, logarithms(noisy), 20_000).lag_us == pytest.approx(0, abs=500)


def test_without_any_change_there_is_no_agreement(events, pictures):
    t_us, values = pictures
    change = changes(of(events), 0, t_us, logarithms(np.full_like(values, 2000)))
    polarity = of(events).polarity
    assert agreement(polarity, change) == spread(polarity, change) == 0
    assert np.isnan(thresholds(polarity[:0], change[:0]).on)
    # dark pixels, and steps outside of the pictures, do not count
    assert np.isnan(changes(of(events), 0, t_us, logarithms(np.full_like(values, 63)))).all()
    assert np.isnan(changes(of(events), 2_000_000, t_us, logarithms(values))).all()
