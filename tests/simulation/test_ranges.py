"""Parameters that each sequence draws: within their ranges, independent of each other, refused where senseless."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from polarnet.simulation.camera import IDEAL, PERFECT, Camera
from polarnet.simulation.emulator import emulate
from polarnet.simulation.presets import MOTIONS, SENSORS
from polarnet.simulation.sequence import simulate
from polarnet.storage.events import EventStore

SENSOR = SENSORS["default"]


def randomised(**ranges) -> Camera:
    return Camera(dataclasses.replace(SENSOR, randomise=ranges))


def test_every_range_of_the_preset_is_kept_and_used():
    camera = Camera(SENSORS["random"])
    drawn = [camera.drawn(1, f"sequence {number}").sensor for number in range(200)]
    for name, (lowest, highest) in SENSORS["random"].randomise.items():
        values = [getattr(sensor, name) for sensor in drawn]
        assert lowest <= min(values) < max(values) <= highest
    assert all(sensor.randomise is None for sensor in drawn)
    others = {field.name for field in dataclasses.fields(SENSOR)} - {*SENSORS["random"].randomise, "randomise"}
    assert all(getattr(sensor, name) == getattr(SENSOR, name) for sensor in drawn for name in others)


def test_rates_are_uniform_in_their_logarithm_and_other_parameters_uniform():
    camera = randomised(shot_noise_rate_hz=[0.001, 10.0], refractory_period_us=[0.0, 1000.0])
    drawn = [camera.drawn(1, str(number)).sensor for number in range(400)]
    # the median of 400 has a standard deviation of 1/40 of the range: 4 decades, and 1000 us
    assert np.median([math.log10(s.shot_noise_rate_hz) for s in drawn]) == pytest.approx(-1, abs=0.3)
    assert np.median([s.refractory_period_us for s in drawn]) == pytest.approx(500, abs=75)


def test_a_draw_depends_on_seed_and_sequence_and_not_on_the_other_ranges():
    alone, both = randomised(cutoff_hz=[30.0, 300.0]), randomised(leak_rate_hz=[0.01, 0.1], cutoff_hz=[30.0, 300.0])
    first = alone.drawn(1, "a").sensor.cutoff_hz
    assert both.drawn(1, "a").sensor.cutoff_hz == first
    assert len({first, alone.drawn(2, "a").sensor.cutoff_hz, alone.drawn(1, "b").sensor.cutoff_hz}) == 3


def test_polarizers_and_readout_are_drawn_too_each_angle_by_itself():
    polarizers = dataclasses.replace(IDEAL, randomise={"angle_error_deg": [-2.0, 2.0], "extinction_ratio": [10, 1000]})
    readout = dataclasses.replace(PERFECT, randomise={"jitter_us": [0.0, 100.0]})
    camera = Camera(SENSOR, polarizers, readout)
    drawn = camera.drawn(1, "a")
    assert len(set(drawn.polarizers.angle_error_deg)) == 4
    assert all(-2 <= error <= 2 for error in drawn.polarizers.angle_error_deg)
    assert all(10 <= ratio <= 1000 for ratio in drawn.polarizers.extinction_ratio)
    assert 0 < drawn.readout.jitter_us < 100
    assert camera.draws(1, "a")["readout"] == {"jitter_us": drawn.readout.jitter_us}


def test_a_pixel_model_is_drawn_among_names_as_often_as_each_stands_in_the_list():
    camera = randomised(model=["exact", "exact", "exact", "dvs_voltmeter"])
    drawn = [camera.drawn(1, str(number)).sensor.model for number in range(400)]
    # of 400, with probability 1/4: 100, with a standard deviation of 8.7
    assert drawn.count("dvs_voltmeter") == pytest.approx(100, abs=35)
    assert drawn.count("exact") + drawn.count("dvs_voltmeter") == 400


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"cutoff_hz": [300.0, 30.0]}, r"^randomise.cutoff_hz: expected \[lowest, highest\], got \[300.0, 30.0\]$"),
        ({"cutof_hz": [30.0, 300.0]}, r"^randomise.cutof_hz: expected one of .*, cutoff_hz, .*, got 'cutof_hz'$"),
        ({"randomise": [0.0, 1.0]}, r"^randomise.randomise: expected one of hot_pixel_share, "),
        ({"cutoff_hz": [0.0, 300.0]}, r"^randomise.cutoff_hz: expected a lowest value > 0, .* logarithm is drawn$"),
        ({"leak_jitter": [0.0, 1.5]}, r"^randomise.leak_jitter: expected <= 1, got 1.5$"),
        ({"model": ["exact", "mine"]}, r"^randomise.model: expected one of v2e, exact.*, got 'mine'"),
        ({"model": []}, r"^randomise.model: expected at least one name, got \[\]$"),
        ({"model": [0.0, 1.0]}, r"^randomise.model: expected one of v2e, exact"),
    ],
)
def test_a_range_that_makes_no_sense_is_refused_by_its_key(ranges, message):
    with pytest.raises(ValueError, match=message):
        randomised(**ranges)


def test_a_simulation_tells_the_camera_that_it_drew():
    motion = dataclasses.replace(MOTIONS["default"], sensor_height=16, sensor_width=16, duration_s=0.1)
    picture = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(1))
    result = simulate(picture, motion, SENSORS["random"], seed=1)
    assert 0.08 < result.camera.sensor.contrast_threshold_on < 0.31
    again = simulate(picture, motion, result.camera, seed=1)
    assert all(torch.equal(a.t, b.t) for a, b in zip(result.events, again.events, strict=True))


def test_the_event_store_holds_what_each_sequence_drew(simulated):
    store = EventStore.open(simulated.events)
    for sequence in store.sequences:
        values = store.record(sequence)["drawn"]["emulate"]
        assert values.keys() == simulated.camera.sensor.randomise.keys()
        assert values["cutoff_hz"] == simulated.camera.drawn(simulated.seed, sequence).sensor.cutoff_hz


def test_no_sensor_of_the_random_preset_has_more_mismatch_than_measured_ones():
    """55 % of the ON and 28 % of the OFF threshold; 1200 of the corner's 10,000 pixels had a threshold of 0.01."""
    ranges = SENSORS["random"].randomise
    assert ranges["contrast_threshold_mismatch_on"][1] <= 0.55
    assert ranges["contrast_threshold_mismatch_off"][1] <= 0.28
    corner = {"contrast_threshold_on": ranges["contrast_threshold_on"][0], "contrast_threshold_mismatch_on": 0.55}
    config = dataclasses.replace(SENSORS["random"], randomise=None, **corner)
    _, state = emulate(np.full((1, 1, 100, 100), 90.0), np.zeros(1), config, key=1)
    assert (state.pixels[0].threshold_on <= 0.011).mean() < 1e-3
