from dataclasses import replace

import pytest
import torch

from polarnet.networks.paper.dolp_unet import DolpUNet, DolpUNetConfig, compressed, contrasts

PAPER = DolpUNetConfig(
    channels=[32, 64, 128], swin_depth=2, swin_window=5, swin_heads=[2, 4], residual_blocks=2, input_mixing="contrasts"
)
SMALL = DolpUNetConfig(
    channels=[4, 8, 8], swin_depth=2, swin_window=4, swin_heads=[1, 2], residual_blocks=1, input_mixing="contrasts"
)


def test_the_papers_network_has_this_many_parameters():
    def count(module: torch.nn.Module) -> int:
        return sum(p.numel() for p in module.parameters())

    network = DolpUNet(PAPER)
    assert count(network.c1) == 4 * 32 * 9 + 32
    assert count(network.g2) == 128 * 9 * 128 * 6 + 3 * 128  # three kernels for the input, three for the state
    assert count(network.d1) == 64 * 32 + 32 + 32 * 32 * 9 + 32
    assert count(network.p1) == 32 + 1
    assert count(network) == 2_293_581


@torch.no_grad()
def test_the_papers_input_is_the_four_event_tensors_as_they_are():
    torch.manual_seed(0)
    network, tensors = DolpUNet(replace(SMALL, input_mixing="polarizers")).eval(), 3 * torch.randn(1, 4, 12, 20)
    inputs_of_c1 = []
    network.c1.register_forward_pre_hook(lambda _, inputs: inputs_of_c1.append(inputs[0]))
    network(tensors)
    torch.testing.assert_close(inputs_of_c1[0], tensors, rtol=0, atol=0)


def test_inputs_are_compressed_logarithmically_with_their_sign():
    values = torch.tensor([[-(torch.e - 1), 0.0, torch.e - 1]])
    torch.testing.assert_close(compressed(values), torch.tensor([[-1.0, 0.0, 1.0]]))


def test_the_channels_are_those_of_the_stokes_parameters_for_each_bin_of_its_own():
    channels = torch.arange(8.0).view(8, 1, 1) ** 2  # two bins of each of the four polarizers
    expected = [(0 + 4 + 16 + 36) / 2, (1 + 9 + 25 + 49) / 2, 0 - 16, 1 - 25, 4 - 36, 9 - 49, 16 - 40, 26 - 58]
    assert contrasts(channels).flatten().tolist() == expected
    assert contrasts(torch.full((4, 1, 1), 3.0)).flatten().tolist() == [6, 0, 0, 0]  # light that is not polarized


def test_heads_that_do_not_divide_the_channels_are_refused():
    with pytest.raises(ValueError, match="swin_heads: expected a divisor of 64 channels, got 3"):
        replace(PAPER, swin_heads=[3, 4])
