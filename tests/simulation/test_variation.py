import math

import numpy as np
import pytest
import torch

from polarnet.simulation.variation import VariationConfig, varied

CONFIG = VariationConfig(
    scenes_per_picture=1,
    share=1.0,
    dolp_factor=[0.1, 1.3],
    dolp_exponent_spread=0.4,
    s0_factor=[0.5, 1.0],
    s0_exponent_spread=0.35,
)


def scene() -> torch.Tensor:
    torch.manual_seed(0)
    return torch.rand(3, 20, 30) * torch.tensor([1.0, 1.0, math.pi]).view(3, 1, 1)


def test_a_variant_is_physical_and_another_scene():
    for seed in range(20):
        s0, dolp, aolp = varied(scene(), CONFIG, np.random.default_rng(seed))
        assert s0.min() >= 0
        assert s0.max() <= 1
        assert dolp.min() >= 0
        assert dolp.max() <= 0.99
        assert aolp.min() >= 0
        assert aolp.max() < math.pi
        assert not torch.allclose(aolp, scene()[2], atol=1e-3)


def test_shapes_stay_brighter_stays_brighter_and_more_polarized_more_polarized():
    s0, dolp, _ = varied(scene(), CONFIG, np.random.default_rng(3))
    assert torch.equal(scene()[0].flatten().argsort(), s0.flatten().argsort())
    below = dolp < 0.99
    assert torch.equal(scene()[1][below].argsort(), dolp[below].argsort())


def test_with_no_share_only_angles_turn_and_all_alike():
    config = VariationConfig(1, 0.0, [0.1, 1.3], 0.4, [0.5, 1.0], 0.35)
    s0, dolp, aolp = varied(scene(), config, np.random.default_rng(1))
    assert torch.equal(s0, scene()[0])
    assert torch.equal(dolp, scene()[1])
    turns = [torch.exp(2j * (aolp - sign * scene()[2])) for sign in (1, -1)]
    assert min((turn - turn[0, 0]).abs().max().item() for turn in turns) < 1e-5


def test_a_range_upside_down_is_refused():
    with pytest.raises(ValueError, match="dolp_factor: expected a smaller and a greater number"):
        VariationConfig(1, 0.5, [1.3, 0.1], 0.4, [0.5, 1.0], 0.35)
