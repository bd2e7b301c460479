"""Variants of scenes, and parameters that each sequence draws: within their ranges and independent of each other."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from polarnet.simulation import MOTIONS, SENSORS, simulate
from polarnet.simulation.camera import Camera
from polarnet.simulation.variation import VariationConfig, varied
from polarnet.storage.events import EventStore

CONFIG = VariationConfig(
    scenes_per_picture=1, share=1.0, dolp_factor=[0.1, 1.3], dolp_exponent_spread=0.4, dolp_spacing="linear",
    s0_factor=[0.5, 1.0], s0_exponent_spread=0.35, uniform_share=0.0, uniform_weight=[0.5, 1.0],
)  # fmt: skip


def scene() -> torch.Tensor:
    torch.manual_seed(0)
    return torch.rand(3, 20, 30) * torch.tensor([1.0, 1.0, math.pi]).view(3, 1, 1)


def test_a_variant_is_another_physical_scene_in_which_brighter_and_more_polarized_stay_so():
    for seed in range(20):
        s0, dolp, aolp = varied(scene(), CONFIG, np.random.default_rng(seed))
        assert 0 <= s0.min() <= s0.max() <= 1
        assert 0 <= dolp.min() <= dolp.max() <= 0.99
        assert 0 <= aolp.min() <= aolp.max() < math.pi
        assert not torch.allclose(aolp, scene()[2], atol=1e-3)
    s0, dolp, _ = varied(scene(), CONFIG, np.random.default_rng(3))
    assert torch.equal(scene()[0].flatten().argsort(), s0.flatten().argsort())
    below = dolp < 0.99
    assert torch.equal(scene()[1][below].argsort(), dolp[below].argsort())


def factors(spacing: str) -> np.ndarray:
    config = replace(CONFIG, dolp_spacing=spacing, dolp_factor=[0.01, 1.0], dolp_exponent_spread=0.0)
    means = [varied(scene(), config, np.random.default_rng(seed))[1].mean() for seed in range(200)]
    return np.array(means) / float(scene()[1].mean())


def test_a_logarithmic_factor_is_as_often_below_a_tenth_as_above_and_senseless_ones_are_refused():
    assert 0.4 < (factors("logarithmic") < 0.1).mean() < 0.6
    assert (factors("linear") < 0.1).mean() < 0.2
    with pytest.raises(ValueError, match="expected numbers above 0"):
        replace(CONFIG, dolp_spacing="logarithmic", dolp_factor=[0.0, 1.0])
    with pytest.raises(ValueError, match="dolp_factor: expected \\[smaller, larger\\]"):
        replace(CONFIG, dolp_factor=[1.3, 0.1])


def test_with_no_share_only_angles_turn_and_a_weight_of_one_half_halves_the_variation():
    config = replace(CONFIG, share=0.0)
    s0, dolp, aolp = varied(scene(), config, np.random.default_rng(1))
    assert torch.equal(s0, scene()[0])
    assert torch.equal(dolp, scene()[1])
    turns = [torch.exp(2j * (aolp - sign * scene()[2])) for sign in (1, -1)]
    assert min((turn - turn[0, 0]).abs().max().item() for turn in turns) < 1e-5
    plain = replace(CONFIG, share=0.0)
    even = replace(plain, uniform_share=1.0, uniform_weight=[0.5, 0.5])

    def stokes(config: VariationConfig) -> torch.Tensor:
        _, dolp, aolp = varied(scene(), config, np.random.default_rng(2))
        return dolp * torch.exp(2j * aolp)

    torch.testing.assert_close(stokes(even) - stokes(even).mean(), (stokes(plain) - stokes(plain).mean()) / 2)


SENSOR = SENSORS["default"]


def randomised(**ranges) -> Camera:
    return Camera(dataclasses.replace(SENSOR, randomise=ranges))


def test_every_range_is_kept_and_used_and_a_pixel_model_drawn_as_often_as_it_stands():
    camera = Camera(SENSORS["random"])
    drawn = [camera.drawn(1, f"sequence {number}").sensor for number in range(200)]
    for name, (lowest, highest) in SENSORS["random"].randomise.items():
        values = [getattr(sensor, name) for sensor in drawn]
        assert lowest <= min(values) < max(values) <= highest
    assert all(sensor.randomise is None for sensor in drawn)
    others = {field.name for field in dataclasses.fields(SENSOR)} - {*SENSORS["random"].randomise, "randomise"}
    assert all(getattr(sensor, name) == getattr(SENSOR, name) for sensor in drawn for name in others)
    camera = randomised(model=["exact", "exact", "exact", "dvs_voltmeter"])
    drawn = [camera.drawn(1, str(number)).sensor.model for number in range(400)]
    # of 400, with probability 1/4: 100, with a standard deviation of 8.7
    assert drawn.count("dvs_voltmeter") == pytest.approx(100, abs=35)
    assert drawn.count("exact") + drawn.count("dvs_voltmeter") == 400


def test_rates_are_uniform_in_their_logarithm_and_a_draw_depends_on_seed_and_sequence_alone():
    camera = randomised(shot_noise_rate_hz=[0.001, 10.0], refractory_period_us=[0.0, 1000.0])
    drawn = [camera.drawn(1, str(number)).sensor for number in range(400)]
    # the median of 400 has a standard deviation of 1/40 of the range: 4 decades, and 1000 us
    assert np.median([math.log10(s.shot_noise_rate_hz) for s in drawn]) == pytest.approx(-1, abs=0.3)
    assert np.median([s.refractory_period_us for s in drawn]) == pytest.approx(500, abs=75)
    alone, both = randomised(cutoff_hz=[30.0, 300.0]), randomised(leak_rate_hz=[0.01, 0.1], cutoff_hz=[30.0, 300.0])
    first = alone.drawn(1, "a").sensor.cutoff_hz
    assert both.drawn(1, "a").sensor.cutoff_hz == first
    assert len({first, alone.drawn(2, "a").sensor.cutoff_hz, alone.drawn(1, "b").sensor.cutoff_hz}) == 3


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"cutoff_hz": [300.0, 30.0]}, r"^randomise.cutoff_hz: expected \[lowest, highest\], got \[300.0, 30.0\]$"),
        ({"cutof_hz": [30.0, 300.0]}, r"^randomise.cutof_hz: expected one of .*, cutoff_hz, .*, got 'cutof_hz'$"),
        ({"randomise": [0.0, 1.0]}, r"^randomise.randomise: expected one of knee_dn, "),
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


def test_a_simulation_and_the_event_store_tell_what_was_drawn(simulated):
    motion = dataclasses.replace(MOTIONS["default"], sensor_height=16, sensor_width=16, duration_s=0.1)
    picture = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(1))
    result = simulate(picture, motion, SENSORS["random"], seed=1)
    assert 0.08 < result.camera.sensor.contrast_threshold_on < 0.31
    again = simulate(picture, motion, result.camera, seed=1)
    assert all(torch.equal(a.t, b.t) for a, b in zip(result.events, again.events, strict=True))
    store = EventStore.open(simulated.events)
    for sequence in store.sequences:
        values = store.record(sequence)["drawn"]["emulate"]
        assert values.keys() == simulated.camera.sensor.randomise.keys()
        assert values["cutoff_hz"] == simulated.camera.drawn(simulated.seed, sequence).sensor.cutoff_hz
