import pytest
import torch

from polarnet.networks.paper.swin import (
    WindowAttention,
    attend,
    join_windows,
    relative_position,
    split_windows,
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


def test_relative_position_depends_on_the_offset_alone():
    index = relative_position(3, CPU)  # pixels 0 1 2 / 3 4 5 / 6 7 8
    assert index[0, 4] == index[4, 8] == index[1, 5]  # one down, one right
    assert index[0, 4] != index[4, 0]
    assert index.unique().numel() == 5 * 5
