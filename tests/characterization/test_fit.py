"""A sensor fitted blind to simulated recordings."""

import dataclasses

import numpy as np
import pytest

from polarnet.characterization.fit import fit_sensor, piled_up_us
from polarnet.characterization.flicker import Flicker
from polarnet.events.stream import Events
from polarnet.recordings.noise import event_counts
from polarnet.simulation.emulator import emulate
from polarnet.simulation.presets import SENSORS

TRUTH = dataclasses.replace(
    SENSORS["default"],
    contrast_threshold_on=0.18, contrast_threshold_off=0.27,
    contrast_threshold_sigma_on=0.02, contrast_threshold_sigma_off=0.045, contrast_threshold_correlation=0.5,
    cutoff_hz=80.0, leak_rate_hz=0.1, shot_noise_rate_hz=1.0, hot_pixel_share=0.02, hot_pixel_rate_hz=60.0,
)  # fmt: skip
HEIGHT, WIDTH = 24, 32


def emulated(light, t_us) -> Events:
    """Events of the sensor whose pixels all see the same light, in DN at these times."""
    frames = np.repeat(np.float32(light), HEIGHT * WIDTH).reshape(-1, 1, HEIGHT, WIDTH)
    (events,), _ = emulate(frames, t_us, TRUTH, 3)
    return events


@pytest.fixture(scope="module")
def static():
    t_us = np.arange(0, 121, 5) * 1e6
    return emulated(np.full(len(t_us), 200), t_us)


@pytest.fixture(scope="module")
def flickers() -> list[tuple[Events, Flicker]]:
    """Two flickers of unknown phase."""
    recordings = []
    for frequency_hz, stop_us in ((2.0, 4e6), (20.0, 2e6)):
        flicker = Flicker(100.0, 0.8, frequency_hz)
        t_us = np.linspace(0, stop_us, round(64e-6 * stop_us * frequency_hz) + 1)  # 64 steps a cycle
        light = flicker.light(2e-6 * np.pi * frequency_hz * t_us)
        recordings.append((emulated(np.roll(light, 321), t_us), flicker))
    return recordings


@pytest.fixture(scope="module")
def fit(static, flickers):
    return fit_sensor(static, 200.0, flickers, SENSORS["default"])


@pytest.mark.thorough
def test_a_static_and_two_flicker_recordings_give_the_sensor_and_its_hot_pixels(fit, static):
    tolerances = {
        "contrast_threshold_on": 0.03, "contrast_threshold_off": 0.03, "contrast_threshold_sigma_on": 0.12,
        "contrast_threshold_sigma_off": 0.12, "contrast_threshold_correlation": 0.24, "cutoff_hz": 0.1,
        "leak_rate_hz": 0.15, "shot_noise_rate_hz": 0.1,
    }  # fmt: skip
    for name, tolerance in tolerances.items():
        assert fit.estimates[name].value == pytest.approx(getattr(TRUTH, name), rel=tolerance), name
    hot = int((event_counts(static) > 0.5 * 60 * 120).sum())  # 7200 events each; the others have about 130
    assert hot == pytest.approx(0.02 * HEIGHT * WIDTH, abs=12)
    assert fit.estimates["hot_pixel_share"].value == pytest.approx(hot / (HEIGHT * WIDTH))
    assert fit.estimates["hot_pixel_rate_hz"].value == pytest.approx(60.0, rel=0.02)


@pytest.mark.thorough
def test_what_the_recordings_do_not_show_is_missing(static, flickers):
    fit = fit_sensor(static, 200.0, [], SENSORS["default"])
    assert fit.missing["contrast_threshold_on"] == "needs a flicker recording"
    assert "contrast_threshold_on" not in fit.parameters()
    assert fit.parameters()["leak_rate_hz"] == pytest.approx(0.1, rel=0.1)
    fit = fit_sensor(None, 127.5, flickers[1:], SENSORS["default"])
    assert fit.missing["shot_noise_rate_hz"] == "needs a static recording"


@pytest.mark.thorough
def test_a_flicker_given_as_static_is_noted_and_another_sensor_refused(fit, flickers, static):
    assert not any("constant" in note for note in fit.notes)
    assert "was not constant" in fit_sensor(flickers[0][0], 200.0, [], SENSORS["default"]).notes[0]
    with pytest.raises(ValueError, match="one sensor"):
        fit_sensor(Events.empty(8, 8), 200.0, flickers, SENSORS["default"])


def test_the_refractory_period_is_where_intervals_pile_up():
    free = np.random.default_rng(1).uniform(5e3, 1e5, 1000).round()
    assert piled_up_us([np.append(free, np.full(200, 500.0))]).value == 500
    assert piled_up_us([free]) is None
    assert piled_up_us([np.repeat([1e3, 2e3, 3e3], [500, 50, 50])]) is None  # at ticks of the clock
