import torch

from polarnet.networks.paper.swin import (
    PatchMerging,
    SwinBlock,
    WindowAttention,
    attend,
    join_windows,
    relative_position,
    split_windows,
    visible_pixels,
)

CPU = torch.device("cpu")


def influence(attention: WindowAttention, row: int, column: int, height: int, width: int) -> torch.Tensor:
    """Which output pixels change when one input pixel does."""
    torch.manual_seed(1)
    image = torch.randn(1, height, width, attention.qkv.in_features)
    changed = image.clone()
    changed[0, row, column] += 1
    return (attention(changed) != attention(image)).any(dim=-1)[0]


def test_windows_put_back_together_give_the_image_for_any_size_and_shift():
    for height, width, window, shift in ((10, 15, 5, 0), (10, 15, 5, 2), (7, 9, 4, 0), (7, 9, 4, 2), (3, 3, 5, 2)):
        image = torch.randn(2, height, width, 12)
        windows = split_windows(torch.cat([image, image, image], dim=-1), 3, window, shift)
        for part in windows:
            assert torch.equal(join_windows(part, height, width, window, shift), image)


def test_plain_windows_see_their_own_window_and_nothing_else():
    pixels = influence(WindowAttention(8, 2, window=4, shift=0), row=5, column=2, height=8, width=8)
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[4:8, 0:4] = True
    assert torch.equal(pixels, expected)


def test_shifted_windows_straddle_the_plain_ones():
    pixels = influence(WindowAttention(8, 2, window=4, shift=2), row=3, column=3, height=8, width=8)
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[2:6, 2:6] = True
    assert torch.equal(pixels, expected)


def test_shifted_windows_do_not_leak_from_one_border_to_the_opposite_one():
    pixels = influence(WindowAttention(8, 2, window=4, shift=2), row=0, column=0, height=8, width=8)
    expected = torch.zeros(8, 8, dtype=torch.bool)
    expected[:2, :2] = True
    assert torch.equal(pixels, expected)


def test_a_window_that_reaches_beyond_the_image_gives_what_the_part_inside_would_give_alone():
    torch.manual_seed(0)
    query, key, value = torch.randn(3, 1, 1, 2, 16, 4).unbind()
    bias = torch.randn(2, 16, 16)
    inside = torch.arange(16).view(4, 4)[:3, :2].flatten()
    visible = torch.zeros(1, 1, 1, 16, dtype=torch.bool)
    visible[..., inside] = True
    masked = attend(query, key, value, bias, visible)[..., inside, :]
    part = [tensor[..., inside, :] for tensor in (query, key, value)]
    torch.testing.assert_close(masked, attend(*part, bias[:, inside][:, :, inside], None))


def test_nothing_is_masked_where_windows_fill_the_image():
    assert visible_pixels(60, 90, 5, 0, CPU) is None
    assert visible_pixels(61, 90, 5, 0, CPU) is not None


def test_masks_and_position_indices_are_made_once_and_kept():
    assert visible_pixels(7, 9, 4, 2, CPU) is visible_pixels(7, 9, 4, 2, CPU)
    assert relative_position(5, CPU) is relative_position(5, CPU)


def test_relative_position_depends_on_the_offset_alone():
    index = relative_position(3, CPU)  # pixels 0 1 2 / 3 4 5 / 6 7 8
    assert index[0, 4] == index[4, 8] == index[1, 5]  # one down, one right
    assert index[0, 4] != index[4, 0]
    assert index.unique().numel() == 5 * 5


def test_attention_of_equal_pixels_is_their_value():
    value = torch.tensor([2.0, -1.0]).expand(1, 1, 1, 9, 2).contiguous()
    attended = attend(torch.zeros_like(value), torch.zeros_like(value), value, torch.zeros(1, 9, 9), None)
    torch.testing.assert_close(attended, value)


def test_patch_merging_halves_an_even_size():
    assert PatchMerging(4, 8)(torch.randn(2, 4, 6, 10)).shape == (2, 3, 5, 8)


def test_a_swin_block_has_the_parameters_that_its_paper_counts():
    channels, heads, window = 64, 2, 5
    norms = 2 * 2 * channels
    attention = 4 * channels**2 + 4 * channels + heads * (2 * window - 1) ** 2
    perceptron = 8 * channels**2 + 5 * channels
    block = SwinBlock(channels, heads, window, shift=2)
    assert sum(p.numel() for p in block.parameters()) == norms + attention + perceptron
