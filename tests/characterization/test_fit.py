"""A sensor fitted blind to simulated recordings, and its twin."""

import dataclasses

import cv2
import numpy as np
import pytest

from polarnet.characterization.fit import fit_sensor
from polarnet.characterization.intervals import between_shot_noise_us, piled_up_us
from polarnet.characterization.light import Flicker, KnownLight, MovingLight
from polarnet.characterization.twin import compare, emulated, fitted_parameters, fitted_sensor, frames_of
from polarnet.pictures.dead_leaves import dead_leaves
from polarnet.recordings.noise import event_counts
from polarnet.simulation.presets import SENSORS

TRUTH = dataclasses.replace(
    SENSORS["default"],
    contrast_threshold_on=0.18, contrast_threshold_off=0.27,
    contrast_threshold_sigma_on=0.02, contrast_threshold_sigma_off=0.045, contrast_threshold_correlation=0.5,
    cutoff_hz=80.0, leak_rate_hz=0.1, shot_noise_rate_hz=1.0, hot_pixel_share=0.02, hot_pixel_rate_hz=60.0,
)  # fmt: skip
HEIGHT, WIDTH = 24, 32


@pytest.fixture(scope="module")
def static():
    t_us = np.arange(0, 121, 5) * 1e6
    return emulated(np.broadcast_to(np.float32(200), (len(t_us), HEIGHT, WIDTH)), t_us, TRUTH, 3)


@pytest.fixture(scope="module")
def moving() -> KnownLight:
    """Dead leaves that drift along a Lissajous figure."""
    t_us, margin = np.arange(2501) * 2e3, 80
    leaves = dead_leaves(np.random.default_rng(1), HEIGHT + 2 * margin, WIDTH + 2 * margin).mean(axis=2)
    leaves = (255 * np.clip(cv2.GaussianBlur(leaves, (0, 0), 1.0), 0.04, 1)).astype(np.float32)
    places = margin + 60 * np.sin(np.outer(t_us * 1e-6, [1.0, 0.77]) + np.array([0, 1]))
    light = np.stack([cv2.warpAffine(leaves, np.array([[1, 0, -x], [0, 1, -y]]), (WIDTH, HEIGHT)) for x, y in places])
    return KnownLight("moving", emulated(light, t_us, TRUTH, 3), MovingLight(light[::2], t_us[::2]))


@pytest.fixture(scope="module")
def fit(static, moving):
    return fit_sensor(static, 200.0, [moving])


def test_a_static_and_a_moving_recording_give_the_sensor(fit):
    tolerances = {
        "contrast_threshold_on": 0.03, "contrast_threshold_off": 0.03, "contrast_threshold_sigma_on": 0.12,
        "contrast_threshold_sigma_off": 0.12, "contrast_threshold_correlation": 0.24, "cutoff_hz": 0.1,
        "leak_rate_hz": 0.15, "shot_noise_rate_hz": 0.1,
    }  # fmt: skip
    for name, tolerance in tolerances.items():
        assert fit.estimates[name].value == pytest.approx(getattr(TRUTH, name), rel=tolerance), name


@pytest.mark.thorough
def test_a_flicker_of_unknown_phase_gives_thresholds_and_bandwidth():
    flicker = Flicker(100.0, 0.8, 20.0)
    light, t_us = frames_of(flicker, 0.0, 2e6, 12, 16)
    events = emulated(np.roll(light, 321, axis=0), t_us, TRUTH, 3)
    fit = fit_sensor(None, 127.5, [KnownLight("flicker", events, flicker)])
    assert fit.estimates["contrast_threshold_on"].value == pytest.approx(0.18, rel=0.06)
    assert fit.estimates["contrast_threshold_off"].value == pytest.approx(0.27, rel=0.06)
    assert fit.estimates["cutoff_hz"].value == pytest.approx(80, rel=0.15)
    assert fit.missing["shot_noise_rate_hz"] == "needs a static recording"


@pytest.mark.thorough
def test_without_known_light_thresholds_are_missing_and_keep_the_default(static):
    fit = fit_sensor(static, 200.0, [])
    assert "moving recording with frames" in fit.missing["contrast_threshold_on"]
    sensor = fitted_sensor(fit, SENSORS["default"])
    assert sensor.contrast_threshold_on == SENSORS["default"].contrast_threshold_on
    assert sensor.leak_rate_hz == pytest.approx(0.1, rel=0.1)


@pytest.mark.thorough
def test_a_moving_recording_given_as_the_static_one_is_noted(fit, moving):
    assert not any("constant" in note for note in fit.notes)
    assert "was not constant" in fit_sensor(moving.events, 200.0, []).notes[0]


def test_hot_pixels_are_counted_and_their_rate_is_their_mean(fit, static):
    hot = int((event_counts(static) > 0.5 * 60 * 120).sum())  # 7200 events each; the others have about 130
    assert hot == pytest.approx(0.02 * HEIGHT * WIDTH, abs=12)
    assert fit.estimates["hot_pixel_share"].value == pytest.approx(hot / (HEIGHT * WIDTH))
    assert fit.estimates["hot_pixel_rate_hz"].value == pytest.approx(60.0, rel=0.02)


def test_the_twin_of_a_simulated_recording_is_like_it(fit, static, moving):
    sensor, parameters = fitted_sensor(fit, SENSORS["default"]), fitted_parameters(fit)
    assert parameters.keys() == fit.estimates.keys()
    assert {name: getattr(sensor, name) for name in parameters} == parameters
    for recording, light in ((moving.events, moving.light), (static, 200.0)):
        comparison = compare("test", recording, light, sensor, seed=1)
        assert comparison.interval_distance < 0.05
        assert comparison.ratio["twin"] == pytest.approx(comparison.ratio["recording"], rel=0.1)
        assert "Kolmogorov-Smirnov" in comparison.verdict


def test_the_refractory_period_is_where_intervals_pile_up():
    free = np.random.default_rng(1).uniform(5e3, 1e5, 1000).round()
    assert piled_up_us([np.append(free, np.full(200, 500.0))]).value == 500
    assert piled_up_us([free]) is None
    assert piled_up_us([np.repeat([1e3, 2e3, 3e3], [500, 50, 50])]) is None  # at ticks of the clock


def test_shot_noise_shows_the_refractory_period_in_which_it_pauses():
    """A million intervals at 2 Hz: two a microsecond, so the fifth shortest is about 2.5 us above 500 us."""
    intervals_us = np.random.default_rng(1).exponential(5e5, 1_000_000)
    assert between_shot_noise_us((500 + intervals_us).round()).value == pytest.approx(500, abs=4)
    assert between_shot_noise_us(intervals_us.round()) is None
    assert between_shot_noise_us((500 + intervals_us[:2000]).round()) is None


def test_recordings_of_two_sensors_are_refused(static, moving):
    other = emulated(*frames_of(200.0, 0, 2e6, 8, 8), TRUTH, 3)
    with pytest.raises(ValueError, match="one sensor"):
        fit_sensor(other, 200.0, [moving])
