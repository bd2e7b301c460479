import math

import pytest
import torch

from polarnet.networks.polarnet.sensor import (
    FEATURES,
    MAX_LOG_SCALE,
    MIN_FEATURE,
    MISMATCH,
    WEIGHTS,
    Equaliser,
    Scale,
    scale_features,
)

HEIGHT, WIDTH = 48, 64


def counts(sensitivity: torch.Tensor, windows: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """ON and OFF events of pixels with relative `sensitivity` [8, h, w] that all see the same swings of light."""
    rates = 2 * sensitivity.expand(windows, 1, 8, HEIGHT, WIDTH)
    events = (rates.cumsum(0) + 0.5).floor().diff(dim=0, prepend=torch.zeros_like(rates[:1]))
    on, off = events.split(4, dim=2)
    return on - off, on + off


def mismatched(spread: float = 0.5) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.empty(8, HEIGHT, WIDTH).uniform_(1 - spread, 1 + spread)


def spread(values: torch.Tensor) -> float:
    return float(values.std() / values.mean())


@torch.no_grad()
def test_pixels_and_polarities_that_fire_more_for_the_same_light_weigh_less():
    polarity, events = counts(mismatched())
    equalised, _ = Equaliser()(polarity, events, [])
    assert spread(events[10:].sum(0)) > 0.19
    assert spread(equalised.events[10:].sum(0)) < 0.1
    assert abs(equalised.mismatch[-1].item() - 1 / 12) < 0.02  # variance of the uniform distribution
    drift, left = (one[10:].sum(0).abs().mean() for one in (polarity, equalised.polarity))
    assert left < 0.4 * drift


@torch.no_grad()
def test_a_sensor_without_mismatch_keeps_its_events_at_edges_of_the_scenes_activity_too():
    polarity, events = counts(torch.ones(8, HEIGHT, WIDTH))
    equalised, _ = Equaliser()(polarity, events, [])
    torch.testing.assert_close(equalised.events, events)
    torch.testing.assert_close(equalised.polarity, polarity)
    torch.testing.assert_close(equalised.mismatch, torch.full((40, 1), MISMATCH[0]))
    busy = torch.ones(8, HEIGHT, WIDTH)
    busy[:, :, WIDTH // 2 :] = 3
    far = Equaliser()(*counts(busy), [])[0].events[-10:].sum(0)
    assert abs(far[..., -8:].mean() / far[..., :8].mean() - 3) < 0.1


@torch.no_grad()
def test_a_hot_pixel_is_silenced_and_does_not_hide_the_others():
    sensitivity = mismatched(0.1)
    sensitivity[0, 20, 20] = 500
    events = counts(sensitivity)[1]
    equalised, _ = Equaliser()(*counts(sensitivity), [])
    assert equalised.events[-1, 0, 0, 20, 20] / events[-1, 0, 0, 20, 20] < 2 * WEIGHTS[0] + 0.5
    assert equalised.events[-10:, 0, 0, 30:, 30:].mean() > 0.9 * events[-10:, 0, 0, 30:, 30:].mean()


def test_the_scale_starts_at_1_stays_within_its_limits_and_gives_way_to_a_known_value():
    torch.manual_seed(0)
    scale = Scale()
    assert scale(torch.randn(3, FEATURES)).flatten().tolist() == [1, 1, 1]
    torch.nn.init.normal_(scale.out.weight)
    values = scale(1e3 * torch.randn(50, FEATURES)).flatten()
    assert values.min() >= math.exp(-MAX_LOG_SCALE) - 1e-6
    assert values.max() <= math.exp(MAX_LOG_SCALE) + 1e-5
    assert values.unique().numel() > 2
    scale.given = 0.5
    assert scale(torch.randn(3, FEATURES)).tolist() == [[[[0.5]]]] * 3


def test_features_are_logarithms_of_spread_slope_and_events_and_the_mismatch():
    ramp = torch.arange(8.0).expand(1, 4, 6, 8) * torch.tensor([1.0, 2.0, 2.0, 5.0]).view(4, 1, 1)
    features = scale_features(ramp, torch.tensor([3.0]), torch.tensor([0.04]))[0]
    spread = torch.arange(8.0).repeat(6).std().item()
    logs = [spread, 2 * spread, 1 / 2, 2 / 2, 3.0]  # the slope is a mean over both axes
    expected = [*(math.log(one + MIN_FEATURE) for one in logs), 0.2]
    assert features.tolist() == pytest.approx(expected, abs=1e-4)
    assert scale_features(torch.zeros(2, 4, 6, 8), torch.zeros(2), torch.full((2,), 0.01)).isfinite().all()
