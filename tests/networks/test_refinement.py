import math

import pytest
import torch
from torch.nn import functional as F

from polarnet.networks.polarnet.refinement import GAIN, USUAL_RATE, ShotNoise, averaged, isolated_events
from polarnet.stokes import intensities_from_stokes, stokes_from_polarization


def noise(rates: list[float], windows: int = 30) -> torch.Tensor:
    """Events that come at random, at one rate per window and pixel for each channel: [windows, 1, 4, h, w]."""
    means = torch.tensor(rates).view(4, 1, 1).expand(windows, 1, 4, 48, 64)
    return torch.poisson(means, torch.Generator().manual_seed(0))


def level(windows: torch.Tensor) -> torch.Tensor:
    """Changes of (s1, s2) after the last window."""
    counts, _ = isolated_events(windows, [])
    return ShotNoise()(counts)[-1].flatten().detach()


def test_an_event_with_another_one_beside_it_or_before_it_is_not_isolated():
    events = torch.zeros(1, 1, 4, 8, 8)
    events[0, 0, 0, 2, 2] = 2  # the second event of the same pixel is neither a neighbour nor counted
    events[0, 0, 1, 4, 4] = events[0, 0, 1, 5, 5] = 1
    events[0, 0, 2, 6, 6] = events[0, 0, 3, 6, 6] = 1  # another channel is no neighbour
    events[0, 0, 3, 1, 1] = 1  # beside four counted pixels, but none itself
    counts, _ = isolated_events(events, [])
    assert counts.isolated.tolist() == [[[1, 0, 1, 1]]]
    assert counts.quiet.tolist() == [[[16, 16 - 4, 16, 16 - 4]]]
    events = torch.zeros(2, 1, 4, 8, 8)
    events[0, 0, 0, 2, 2:4] = 1
    events[0, 0, 1, 2, 2] = 1  # a single one before is allowed
    events[1, 0, :, 2, 2] = 1
    counts, _ = isolated_events(events, [])
    assert (counts.isolated[1] > counts.isolated[0]).tolist() == [[False, True, True, True]]


def test_the_channel_that_fires_less_is_the_brighter_one_if_there_is_much_shot_noise():
    rate = 2 * USUAL_RATE  # nearly all of it is shot noise
    s1, s2 = level(noise([0.8 * rate, rate, 1.2 * rate, rate])).tolist()
    assert s1 == pytest.approx(GAIN * math.log(1.2 / 0.8), abs=0.05)
    assert abs(s2) < 0.05
    events = noise([0.05, 0.1, 0.15, 0.2])
    torch.testing.assert_close(level(events), -level(events[:, :, [2, 3, 0, 1]]))
    assert level(noise([0.005, 0.01, 0.01, 0.02])).abs().max() < 0.01
    assert level(torch.zeros(3, 1, 4, 48, 64)).tolist() == [0, 0]


def test_the_panorama_gives_the_pattern_and_the_network_the_level():
    torch.manual_seed(0)
    coarse = torch.randn(3, 1, 1, 6, 9)
    s0, dolp, aolp = (F.interpolate(image, size=(48, 72), mode="bicubic")[0] for image in coarse)
    truth = stokes_from_polarization(torch.exp(s0)[0], (0.3 + 0.2 * torch.tanh(dolp))[0], (1 + 0.5 * aolp)[0])
    logs = F.avg_pool2d(intensities_from_stokes(truth).log(), 2)[None]
    panorama = (logs[:, :2] - logs[:, 2:]) / 2 + torch.tensor([0.3, -2]).view(1, 2, 1, 1)
    truth = truth[None, 1:] / truth[:1]
    level_only = truth.mean((-1, -2), keepdim=True).expand_as(truth)
    length = truth.norm(dim=1, keepdim=True)
    start = (level_only, level_only.norm(dim=1, keepdim=True), panorama)
    stokes, dolp = averaged(*start, torch.ones(1, 1, 1, 1), around=23)
    assert (stokes - truth).square().mean() < 0.1 * (level_only - truth).square().mean()
    assert (dolp - length).square().mean() < 0.1 * length.var()
    half, _ = averaged(*start, torch.full((1, 1, 1, 1), 0.5), around=23)
    torch.testing.assert_close(half, (level_only + stokes) / 2)
