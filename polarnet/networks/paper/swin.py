"""Swin transformer blocks (Liu et al., ICCV 2021) for images of any size.

Text here says "tile" for a square of an attention layer, which Swin and the parameter `window` call a window.
"""

import functools

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional as F

MLP_RATIO = 4  # hidden width of a block's perceptron relative to its channels, as in Swin-T
BIAS_STD = 0.02  # initial standard deviation of the relative position bias, as in Swin-T


class PatchMerging(nn.Module):
    """Downsampling by 2: merges 2x2 pixels into one, then normalises, as in Swin v2 (Liu et al., CVPR 2022)."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.reduce = nn.Conv2d(inputs, outputs, kernel_size=2, stride=2)
        self.norm = nn.LayerNorm(outputs)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h2 w2 d"]:
        """Return the merged image, channels last; h and w must be even."""
        return self.norm(self.reduce(x).permute(0, 2, 3, 1))


class WindowAttention(nn.Module):
    """Multi-head self-attention with position bias inside square tiles, on a grid that starts at (-shift, -shift).

    Pixels of the grid outside the image are masked. For shift > 0 the neighbourhoods are exactly those of Swin's masked
    cyclic shift, without wrapping the image around.
    """

    def __init__(self, channels: int, heads: int, window: int, shift: int):
        super().__init__()
        self.heads, self.window, self.shift = heads, window, shift
        self.qkv = nn.Linear(channels, 3 * channels)
        self.merge_heads = nn.Linear(channels, channels)
        self.position_bias = nn.Parameter(torch.randn(heads, (2 * window - 1) ** 2) * BIAS_STD)

    def forward(self, x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n h w c"]:
        """Return the attended image, of the same shape."""
        height, width = x.shape[1:3]
        query, key, value = split_windows(self.qkv(x), self.heads, self.window, self.shift)
        bias = self.position_bias[:, relative_position(self.window, x.device)]
        visible = visible_pixels(height, width, self.window, self.shift, x.device)
        attended = attend(query, key, value, bias, visible)
        return self.merge_heads(join_windows(attended, height, width, self.window, self.shift).to(x.dtype))


class SwinBlock(nn.Module):
    """Transformer block: x + attention(norm(x)), then x + perceptron(norm(x))."""

    def __init__(self, channels: int, heads: int, window: int, shift: int):
        super().__init__()
        self.attention_norm = nn.LayerNorm(channels)
        self.attention = WindowAttention(channels, heads, window, shift)
        self.mlp_norm = nn.LayerNorm(channels)
        hidden = MLP_RATIO * channels
        self.mlp = nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels))

    def forward(self, x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n h w c"]:
        """Return a tensor of the same shape."""
        x = x + self.attention(self.attention_norm(x))
        return x + self.mlp(self.mlp_norm(x))


class SwinStage(nn.Module):
    """Patch merging by 2, then `depth` blocks; every second block shifts its tiles by half a tile."""

    def __init__(self, inputs: int, outputs: int, depth: int, heads: int, window: int):
        super().__init__()
        self.merge = PatchMerging(inputs, outputs)
        self.blocks = nn.Sequential(
            *(SwinBlock(outputs, heads, window, shift=window // 2 if i % 2 else 0) for i in range(depth))
        )

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d h2 w2"]:
        """Return the stage's output as channels_last; h and w must be even."""
        return self.blocks(self.merge(x)).permute(0, 3, 1, 2)


def attend(
    query: Float[Tensor, "n g heads p d"],
    key: Float[Tensor, "n g heads p d"],
    value: Float[Tensor, "n g heads p d"],
    bias: Float[Tensor, "heads p p"],
    visible: Bool[Tensor, "g 1 1 p"] | None,
) -> Float[Tensor, "n g heads p d"]:
    """Return softmax(query key^T / sqrt(d) + bias) value over the p pixels of each of g tiles, for visible keys only.

    Computed in float32. A bfloat16 product on a CPU is 3 times slower, because its blocks are far larger than the
    tiles.
    """
    with torch.autocast(query.device.type, enabled=False):
        similarity = query.float() * query.shape[-1] ** -0.5 @ key.float().transpose(-1, -2) + bias
        if visible is not None:
            similarity = similarity.masked_fill(~visible, -torch.inf)
        return similarity.softmax(-1) @ value.float()


def split_windows(
    qkv: Float[Tensor, "n h w c3"], heads: int, window: int, shift: int
) -> tuple[Float[Tensor, "n g heads p d"], Float[Tensor, "n g heads p d"], Float[Tensor, "n g heads p d"]]:
    """Split queries, keys and values (float32) into g tiles of p = window^2 pixels, row by row.

    The grid starts at (-shift, -shift) and covers the image; pixels outside the image are 0.
    """
    n, height, width, _ = qkv.shape
    rows, columns = _grid(height, width, window, shift)
    bottom, right = rows * window - height - shift, columns * window - width - shift
    if shift or bottom or right:
        qkv = F.pad(qkv, (0, 0, shift, right, shift, bottom))
    windows = qkv.view(n, rows, window, columns, window, 3, heads, -1).permute(5, 0, 1, 3, 6, 2, 4, 7)
    windows = windows.to(torch.float32, memory_format=torch.contiguous_format).contiguous()
    query, key, value = windows.view(3, n, rows * columns, heads, window * window, -1).unbind()
    return query, key, value


def join_windows(
    windows: Float[Tensor, "n g heads p d"], height: int, width: int, window: int, shift: int
) -> Float[Tensor, "n h w c"]:
    """Reassemble the image from the tiles of `split_windows`, with c = heads * d, without pixels outside the image."""
    n, _, heads, _, _ = windows.shape
    rows, columns = _grid(height, width, window, shift)
    image = windows.view(n, rows, columns, heads, window, window, -1).permute(0, 1, 4, 2, 5, 3, 6)
    image = image.reshape(n, rows * window, columns * window, -1)
    return image[:, shift : shift + height, shift : shift + width]


def _grid(height: int, width: int, window: int, shift: int) -> tuple[int, int]:
    return -(-(height + shift) // window), -(-(width + shift) // window)


@functools.lru_cache(maxsize=32)
def visible_pixels(
    height: int, width: int, window: int, shift: int, device: torch.device
) -> Bool[Tensor, "g 1 1 p"] | None:
    """Return the mask of pixels inside the image for every tile of `split_windows`; None if all are inside."""
    with torch.inference_mode(False):
        ones, _, _ = split_windows(torch.ones(1, height, width, 3), 1, window, shift)
        inside = (ones[0].transpose(-1, -2) > 0).to(device)
    return None if inside.all() else inside


@functools.lru_cache(maxsize=32)
def relative_position(window: int, device: torch.device) -> Int64[Tensor, "p p"]:
    """Return the index into the position bias for query pixel i and key pixel j of a tile, from their offset."""
    with torch.inference_mode(False):
        row, column = torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")
        position = torch.stack([row.flatten(), column.flatten()])
        offset = position[:, :, None] - position[:, None, :] + window - 1
        return (offset[0] * (2 * window - 1) + offset[1]).to(device)
