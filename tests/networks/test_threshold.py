import math

import pytest
import torch

from polarnet.networks.polarnet.threshold import FEATURES, MAX_LOG_SCALE, MIN_FEATURE, Scale, scale_features


def trained() -> Scale:
    torch.manual_seed(0)
    scale = Scale()
    torch.nn.init.normal_(scale.out.weight)
    return scale


def test_before_training_every_sensor_has_the_scale_1():
    assert Scale()(torch.randn(3, FEATURES)).flatten().tolist() == [1, 1, 1]


def test_the_scale_stays_within_its_limits():
    values = trained()(1e3 * torch.randn(50, FEATURES)).flatten()
    assert values.min() >= math.exp(-MAX_LOG_SCALE) - 1e-6
    assert values.max() <= math.exp(MAX_LOG_SCALE) + 1e-5
    assert values.unique().numel() > 2


def test_a_given_scale_replaces_the_estimate():
    scale = trained()
    scale.given = 0.5
    assert scale(torch.randn(3, FEATURES)).tolist() == [[[[0.5]]]] * 3


def test_features_are_logarithms_of_spread_slope_and_events_and_the_mismatch():
    ramp = torch.arange(8.0).expand(1, 4, 6, 8) * torch.tensor([1.0, 2.0, 2.0, 5.0]).view(4, 1, 1)
    features = scale_features(ramp, torch.tensor([3.0]), torch.tensor([0.04]))[0]
    spread = torch.arange(8.0).repeat(6).std().item()
    logs = [spread, 2 * spread, 1 / 2, 2 / 2, 3.0]  # the slope is a mean over both axes
    expected = [*(math.log(one + MIN_FEATURE) for one in logs), 0.2]
    assert features.tolist() == pytest.approx(expected, abs=1e-4)


def test_a_sensor_without_events_has_finite_features():
    assert scale_features(torch.zeros(2, 4, 6, 8), torch.zeros(2), torch.full((2,), 0.01)).isfinite().all()
