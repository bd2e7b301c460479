from dataclasses import replace

import pytest
import torch

from polarnet.networks.paper.dolp_unet import DolpUNet, DolpUNetConfig
from polarnet.networks.paper.swin import WindowAttention, attend, join_windows, split_windows

PAPER = DolpUNetConfig(channels=[32, 64, 128], swin_depth=2, swin_window=5, swin_heads=[2, 4], residual_blocks=2)
SMALL = DolpUNetConfig(channels=[4, 8, 8], swin_depth=2, swin_window=4, swin_heads=[1, 2], residual_blocks=1)


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
    network, tensors = DolpUNet(SMALL).eval(), 3 * torch.randn(1, 4, 12, 20)
    inputs_of_c1 = []
    network.c1.register_forward_pre_hook(lambda _, inputs: inputs_of_c1.append(inputs[0]))
    network(tensors)
    torch.testing.assert_close(inputs_of_c1[0], tensors, rtol=0, atol=0)


def test_heads_that_do_not_divide_the_channels_are_refused():
    with pytest.raises(ValueError, match="swin_heads: expected a divisor of 64 channels, got 3"):
        replace(PAPER, swin_heads=[3, 4])


def influence(attention: WindowAttention, row: int, column: int, height: int, width: int) -> torch.Tensor:
    """Which output pixels change when one input pixel does."""
    torch.manual_seed(1)
    image = torch.randn(1, height, width, attention.qkv.in_features)
    changed = image.clone()
    changed[0, row, column] += 1
    return (attention(changed) != attention(image)).any(dim=-1)[0]


def test_windows_put_back_give_the_image_and_one_beyond_it_what_the_part_inside_would_give():
    for height, width, window, shift in ((10, 15, 5, 0), (10, 15, 5, 2), (7, 9, 4, 0), (7, 9, 4, 2), (3, 3, 5, 2)):
        image = torch.randn(2, height, width, 12)
        windows = split_windows(torch.cat([image, image, image], dim=-1), 3, window, shift)
        for part in windows:
            assert torch.equal(join_windows(part, height, width, window, shift), image)
    torch.manual_seed(0)
    query, key, value = torch.randn(3, 1, 1, 2, 16, 4).unbind()
    bias = torch.randn(2, 16, 16)
    inside = torch.arange(16).view(4, 4)[:3, :2].flatten()
    visible = torch.zeros(1, 1, 1, 16, dtype=torch.bool)
    visible[..., inside] = True
    masked = attend(query, key, value, bias, visible)[..., inside, :]
    part = [tensor[..., inside, :] for tensor in (query, key, value)]
    torch.testing.assert_close(masked, attend(*part, bias[:, inside][:, :, inside], None))


@pytest.mark.parametrize(
    ("shift", "pixel", "rows", "columns"),
    [
        (0, (5, 2), slice(4, 8), slice(0, 4)),  # its own window
        (2, (3, 3), slice(2, 6), slice(2, 6)),  # a window that straddles the plain ones
        (2, (0, 0), slice(0, 2), slice(0, 2)),  # the part of a window inside the image, not the opposite border
    ],
)
def test_a_pixel_is_seen_in_its_window_and_nowhere_else(shift, pixel, rows, columns):
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[rows, columns] = True
    attention = WindowAttention(8, 2, window=4, shift=shift)
    assert torch.equal(influence(attention, *pixel, height=8, width=8), expected)
