import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from polarnet.simulation.variation import VariationConfig, varied

CONFIG = VariationConfig(
    scenes_per_picture=1, share=1.0, dolp_factor=[0.1, 1.3], dolp_exponent_spread=0.4, dolp_spacing="linear",
    s0_factor=[0.5, 1.0], s0_exponent_spread=0.35, uniform_share=0.0, uniform_weight=[0.5, 1.0],
)  # fmt: skip


def scene() -> torch.Tensor:
    torch.manual_seed(0)
    return torch.rand(3, 20, 30) * torch.tensor([1.0, 1.0, math.pi]).view(3, 1, 1)


def test_a_variant_is_physical_and_another_scene():
    for seed in range(20):
        s0, dolp, aolp = varied(scene(), CONFIG, np.random.default_rng(seed))
        assert 0 <= s0.min() <= s0.max() <= 1
        assert 0 <= dolp.min() <= dolp.max() <= 0.99
        assert 0 <= aolp.min() <= aolp.max() < math.pi
        assert not torch.allclose(aolp, scene()[2], atol=1e-3)


def test_shapes_stay_brighter_stays_brighter_and_more_polarized_more_polarized():
    s0, dolp, _ = varied(scene(), CONFIG, np.random.default_rng(3))
    assert torch.equal(scene()[0].flatten().argsort(), s0.flatten().argsort())
    below = dolp < 0.99
    assert torch.equal(scene()[1][below].argsort(), dolp[below].argsort())


def factors(spacing: str) -> np.ndarray:
    config = replace(CONFIG, dolp_spacing=spacing, dolp_factor=[0.01, 1.0], dolp_exponent_spread=0.0)
    means = [varied(scene(), config, np.random.default_rng(seed))[1].mean() for seed in range(200)]
    return np.array(means) / float(scene()[1].mean())


def test_a_logarithmic_factor_is_as_often_below_a_tenth_as_above_and_a_linear_one_is_not():
    assert 0.4 < (factors("logarithmic") < 0.1).mean() < 0.6
    assert (factors("linear") < 0.1).mean() < 0.2


def test_factors_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="expected numbers above 0"):
        replace(CONFIG, dolp_spacing="logarithmic", dolp_factor=[0.0, 1.0])
    with pytest.raises(ValueError, match="dolp_factor: expected \\[smaller, larger\\]"):
        replace(CONFIG, dolp_factor=[1.3, 0.1])


def test_with_no_share_only_angles_turn_and_all_alike():
    config = replace(CONFIG, share=0.0)
    s0, dolp, aolp = varied(scene(), config, np.random.default_rng(1))
    assert torch.equal(s0, scene()[0])
    assert torch.equal(dolp, scene()[1])
    turns = [torch.exp(2j * (aolp - sign * scene()[2])) for sign in (1, -1)]
    assert min((turn - turn[0, 0]).abs().max().item() for turn in turns) < 1e-5


def test_an_even_variant_has_one_polarization_everywhere():
    config = replace(CONFIG, uniform_share=1.0, uniform_weight=[1.0, 1.0])
    polarizations = []
    for seed in range(20):
        s0, dolp, aolp = varied(scene(), config, np.random.default_rng(seed))
        assert s0.std() > 0.05
        assert dolp.std() < 1e-5
        assert torch.exp(2j * (aolp - aolp[0, 0])).real.min() > 0.9999
        polarizations.append((dolp.mean().item(), aolp[0, 0].item()))
    degrees, angles = zip(*polarizations, strict=True)
    assert min(degrees) < 0.3
    assert max(degrees) > 0.7
    assert max(angles) - min(angles) > 1


def test_a_weight_of_one_half_halves_the_variation_of_polarization():
    plain = replace(CONFIG, share=0.0)
    even = replace(plain, uniform_share=1.0, uniform_weight=[0.5, 0.5])

    def stokes(config: VariationConfig) -> torch.Tensor:
        _, dolp, aolp = varied(scene(), config, np.random.default_rng(2))
        return dolp * torch.exp(2j * aolp)

    torch.testing.assert_close(stokes(even) - stokes(even).mean(), (stokes(plain) - stokes(plain).mean()) / 2)
