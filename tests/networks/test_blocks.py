import math

import pytest
import torch
from torch.nn import functional as F

from polarnet.networks.base.blocks import ConvGRU, Level, ResidualBlock, compressed, contrasts, conv3x3, on_blocks


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


@torch.no_grad()
def test_a_conv_gru_of_one_pixel_is_the_textbook_gru():
    gru = ConvGRU(1)
    gru.from_input.bias.zero_()
    centres = {gru.from_input: [0.5, -1.0, 2.0], gru.from_state: [1.0, 0.25], gru.from_reset_state: [-0.5]}
    for convolution, values in centres.items():
        convolution.weight[:, 0, 1, 1] = torch.tensor(values)  # one pixel meets no other weight of a kernel
    x, state = 0.8, 0.4
    reset = sigmoid(0.5 * x + 1.0 * state)
    update = sigmoid(-1.0 * x + 0.25 * state)
    candidate = math.tanh(2.0 * x - 0.5 * reset * state)
    expected = (1 - update) * state + update * candidate
    states, last = gru(torch.full((1, 1, 1, 1), x), 1, torch.full((1, 1, 1, 1), state))
    assert math.isclose(states.item(), expected, rel_tol=1e-6)
    assert torch.equal(states, last)


@torch.no_grad()
@pytest.mark.parametrize(("height", "width"), [(8, 8), (15, 23), (1, 1)])
def test_levels_over_windows_at_once_are_the_same_as_window_by_window(height, width):
    torch.manual_seed(0)
    level, x = Level(3, [4, 5, 6]), torch.randn(6, 3, height, width)
    together, last = level(x, 2, [])
    assert together.shape == x.shape
    states = []
    for window, expected in zip(x.split(2), together.split(2), strict=True):
        alone, states = level(window, 2, states)
        torch.testing.assert_close(alone, expected)
    torch.testing.assert_close(states, last)


@torch.no_grad()
def test_a_convolution_on_blocks_is_that_of_the_unshuffled_image():
    torch.manual_seed(0)
    layer, image = conv3x3(4 * 3, 5), torch.randn(2, 3, 8, 10)
    torch.testing.assert_close(on_blocks(layer, image), layer(F.pixel_unshuffle(image, 2)))


@torch.no_grad()
def test_a_residual_block_with_zero_weights_is_a_relu():
    block = ResidualBlock(2)
    for parameter in block.parameters():
        torch.nn.init.zeros_(parameter)
    assert block(torch.tensor([-1.0, 2.0]).view(1, 2, 1, 1)).flatten().tolist() == [0.0, 2.0]


def test_inputs_are_compressed_contrasts_of_the_channels_bin_by_bin():
    values = torch.tensor([[-(torch.e - 1), 0.0, torch.e - 1]])
    torch.testing.assert_close(compressed(values), torch.tensor([[-1.0, 0.0, 1.0]]))
    channels = torch.arange(8.0).view(8, 1, 1) ** 2  # two bins of each of the four polarizers
    expected = [(0 + 4 + 16 + 36) / 2, (1 + 9 + 25 + 49) / 2, 0 - 16, 1 - 25, 4 - 36, 9 - 49, 16 - 40, 26 - 58]
    assert contrasts(channels).flatten().tolist() == expected
    assert contrasts(torch.full((4, 1, 1), 3.0)).flatten().tolist() == [6, 0, 0, 0]  # light that is not polarized
