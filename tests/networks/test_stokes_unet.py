from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn import functional as F

from polarnet.config.tree import load
from polarnet.networks.polarnet.redundancy import block_means
from polarnet.networks.polarnet.stokes_unet import PARTS, StokesUNet, StokesUNetConfig

PARAMETERS = load(Path(__file__).resolve().parents[2]).networks
CONFIG = replace(
    PARAMETERS.polarnet,
    channels=[8, 8, 8, 8],
    memories=[0.0, 0.5],
    decays=[0.7, 0.9],
    scales=[1, 3, 0],
    reach=5,
    panorama_scale=5,
)


def network(config: StokesUNetConfig = CONFIG, **changes: Any) -> StokesUNet:
    torch.manual_seed(0)
    built = StokesUNet(replace(config, **changes))
    for last in (built.choose, built.gains, built.add, built.trust, built.scale.out):  # which begin with zeros
        torch.nn.init.normal_(last.weight, std=0.1)
    return built.eval()


def events(*shape: int) -> torch.Tensor:
    torch.manual_seed(1)
    return torch.randint(-3, 4, shape).float()


def moving_events(windows: int, height: int, width: int) -> torch.Tensor:
    """Counts of a random picture that moves left by three pixels a window: [windows, 1, 8, h, w]."""
    torch.manual_seed(1)
    picture = torch.randn(1, 4, height // 4, width // 4 + windows)
    picture = 3 * F.interpolate(picture, scale_factor=4, mode="bilinear")[0]
    views = torch.stack([picture[..., 3 * k : 3 * k + width] for k in range(windows + 1)])
    polarity = views.diff(dim=0).round()
    return torch.stack([polarity, polarity.abs()], dim=2).flatten(1, 2)[:, None]


@torch.no_grad()
def test_binning_sees_block_means_and_answers_at_every_pixel():
    inputs = events(3, 2, 8, 24, 40)
    left_out = ["shot_noise"]  # counted at single pixels
    coarse, features, _ = network(binning=1, without=left_out).unroll_with_features(block_means(inputs, 2))
    fine, fine_features, _ = network(binning=2, without=left_out).unroll_with_features(inputs)
    enlarged = F.interpolate(coarse.dolp.flatten(0, 1)[:, None], scale_factor=2, mode="bilinear")
    torch.testing.assert_close(fine.dolp.flatten(0, 1)[:, None], enlarged)
    assert fine.stokes.shape == (3, 2, 2, 24, 40)
    assert fine_features.shape[-2:] == (12, 20) != features.shape[-2:]


def test_shot_noise_is_counted_at_single_pixels_whatever_the_blocks():
    inputs = torch.poisson(torch.full((3, 1, 8, 21, 35), 0.1), torch.Generator().manual_seed(0))
    pixels, blocks = (network(binning=side).solve_windows(inputs, [])[0].noise for side in (1, 2))
    assert pixels.isolated.min() > 0
    assert [torch.equal(one, other) for one, other in zip(pixels, blocks, strict=True)] == [True, True]


def shot_noise(windows: int, height: int, width: int) -> torch.Tensor:
    """ON events at random pixels, most of them in channel 135: [windows, 1, 8, h, w]."""
    chance = torch.tensor([0.1, 0.1, 0.1, 0.2]).view(4, 1, 1)
    noise = (torch.rand(windows, 4, height, width, generator=torch.Generator().manual_seed(2)) < chance).float()
    return noise.repeat_interleave(2, dim=1)[:, None]


@torch.no_grad()
def test_each_part_can_be_left_out_and_then_does_nothing():
    windows = moving_events(4, 48, 64)
    windows[..., :32] = 0  # half of the sensor sees nothing that moves
    windows += shot_noise(4, 48, 64)
    whole, _ = network().unroll(windows)
    without = {part: network(without=[part]) for part in PARTS}
    predictions = {part: built.unroll(windows)[0] for part, built in without.items()}
    assert all((one.dolp - whole.dolp).abs().max() > 1e-3 for one in predictions.values())
    for part, parameter in (
        ("redundancy", without["redundancy"].moments.log_mismatch),
        ("slopes", without["slopes"].slopes.log_activity),
        ("shot_noise", without["shot_noise"].shot_noise.gain),
        ("sums", without["sums"].gains.weight),
        ("recurrence", without["recurrence"].gru_quarter.from_state.weight),
    ):
        parameter.add_(1)
        torch.testing.assert_close(without[part].unroll(windows)[0].dolp, predictions[part].dolp)


@torch.no_grad()
def test_the_panorama_is_averaged_in_where_the_scene_moves():
    moving, blinking = moving_events(4, 48, 64), events(4, 1, 8, 48, 64)
    for windows, changes in ((moving, True), (blinking, False)):
        built = network()
        before, _ = built.unroll(windows)
        built.trust.bias.add_(2)
        assert ((built.unroll(windows)[0].dolp - before.dolp).abs().max() > 1e-3) == changes


@pytest.mark.parametrize(("changes", "message"), [
    ({"without": ["attention"]}, f"without: expected some of {', '.join(PARTS)}, got attention"),
    ({"channels": [8, 8]}, "expected at least 3, 1, 1, 1 numbers"),
    ({"scales": [2]}, "scales: expected odd numbers"),
    ({"panorama_scale": 4}, "panorama_scale: expected an odd number, got 4"),
])  # fmt: skip
def test_settings_that_make_no_network_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **changes)
    with pytest.raises(ValueError, match="expected 8 images a window, got 4"):
        StokesUNet(CONFIG, 4)
