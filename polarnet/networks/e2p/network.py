"""E2P: intensity, AoLP and DoLP from events, with 512,501 parameters (Mei et al., CVPR 2023).

The published network reads one sensor with a polarizer mosaic, 90 45 / 135 0 over each 2x2 pixels. `interleaved` lays
out four full-size channels as such a mosaic of twice the height and width. All layers, including the first, therefore
stay as published, and the result has the size of the channels.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.published import ConvGRU, PublishedNetwork, ResidualBlock
from polarnet.stokes import aolp

CHANNELS = 32
BRANCHES = ("intensity", "aolp", "dolp")
MOSAIC = ((90, 45), (135, 0))  # polarizer angles in degrees over even and odd rows and columns
CELLS = ((0, 0), (0, 1), (1, 0), (1, 1))  # row and column of each polarizer in a 2x2 cell
ATTENTION_KERNEL = 5
GATE_POOL = 4
MIN_SIDE = 2 * GATE_POOL  # smallest height and width of the result: the gate halves the resolution and pools by 4
PUBLISHED_NAME = re.compile(r"(head|G1|G2|R1|R2|pred)_([iad])\.(.*)")


class E2p(PublishedNetwork):
    """Three identical branches for intensity, AoLP and DoLP, coupled by two gates."""

    label = "E2P"
    first_layer = "branches.dolp.head.pattern1.weight"

    def __init__(self, bins: int, aolp_channels: int = 1):
        """`aolp_channels` is 2 for the newer published files, whose AoLP is the sine and cosine of twice the angle."""
        super().__init__(bins)
        channels = {"intensity": 1, "aolp": aolp_channels, "dolp": 1}
        self.branches = nn.ModuleDict({name: Branch(bins, channels[name]) for name in BRANCHES})
        self.fusion_weight1 = CrossBranchGate()
        self.fusion_weight2 = CrossBranchGate()

    def forward(
        self, mosaic: Float[Tensor, "b bins h w"], state: list[Tensor] | None = None
    ) -> tuple[Float[Tensor, "b maps h//2 w//2"], list[Tensor]]:
        """Return unclamped intensity, AoLP and DoLP at the end of one window, and the next state, None at the start.

        The input is an unnormalised voxel grid. AoLP is coded as in `coded_aolp`, or takes two maps, the sine and
        cosine of twice the angle.
        """
        bins, height, width = mosaic.shape[1:]
        if bins != self.bins or height % 2 or width % 2 or min(height, width) < 2 * MIN_SIDE:
            raise ValueError(
                f"this E2P takes {self.bins} bins of even height and width, at least {2 * MIN_SIDE}, "
                f"got {tuple(mosaic.shape[1:])}"
            )
        branches: list[Any] = [*self.branches.values()]
        before: Sequence[Tensor | None] = state or [None] * (2 * len(branches))
        mosaic = mosaic.contiguous(memory_format=torch.channels_last)
        first = [branch.G1(branch.head(mosaic), h) for branch, h in zip(branches, before[: len(branches)], strict=True)]
        x = self.fusion_weight1([branch.R1(h) for branch, h in zip(branches, first, strict=True)])
        second = [branch.G2(y, h) for branch, y, h in zip(branches, x, before[len(branches) :], strict=True)]
        x = self.fusion_weight2([branch.R2(h) for branch, h in zip(branches, second, strict=True)])
        maps = torch.cat([branch.pred(y) for branch, y in zip(branches, x, strict=True)], dim=1)
        return maps.float(), [*first, *second]

    @classmethod
    def variant(cls, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the argument `aolp_channels` for the number of AoLP maps in a published file."""
        head = tensors.get("branches.aolp.pred.weight")
        return {} if head is None else {"aolp_channels": len(head)}

    @classmethod
    def own_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rename head_d.pattern1.0.weight to branches.dolp.head.pattern1.weight, and so on; keep our names."""
        branch_of = {name[0]: name for name in BRANCHES}
        renamed = {}
        for name, tensor in tensors.items():
            if match := PUBLISHED_NAME.fullmatch(name):
                layer, letter, rest = match.groups()
                name = f"branches.{branch_of[letter]}.{layer}.{rest}"
            renamed[re.sub(r"(pattern\d|fusion_weight\d\.conv\d)\.0\.", r"\1.", name)] = tensor
        return renamed


class Branch(nn.Module):
    """Layers of one of the three maps; `E2p.forward` connects them."""

    def __init__(self, bins: int, maps: int):
        super().__init__()
        self.head = MosaicHead(bins)
        self.G1, self.G2 = ConvGRU(CHANNELS), ConvGRU(CHANNELS)
        self.R1, self.R2 = ResidualBlock(CHANNELS), ResidualBlock(CHANNELS)
        self.pred = nn.Conv2d(CHANNELS, maps, 3, padding=1)
        for gate in (gate for gru in (self.G1, self.G2) for gate in gru.children()):
            nn.init.orthogonal_(gate.get_parameter("weight"))
            nn.init.zeros_(gate.get_parameter("bias"))


class MosaicHead(nn.Module):
    """Downsampling by 2 with four 3x3 convolutions, each centred on the pixels of one polarizer, and channel weights.

    The weights (efficient channel attention) are the sigmoid of a convolution over the channel means.
    """

    def __init__(self, bins: int):
        super().__init__()
        self.pattern1, self.pattern2, self.pattern3, self.pattern4 = (
            nn.Conv2d(bins, CHANNELS // 4, 3, stride=2) for _ in CELLS
        )
        self.conv = nn.Conv1d(1, 1, ATTENTION_KERNEL, padding=ATTENTION_KERNEL // 2)

    def forward(self, mosaic: Float[Tensor, "b bins h w"]) -> Float[Tensor, "b 32 h//2 w//2"]:
        """Return the features; each polarizer has a quarter of the channels, in the order of `CELLS`."""
        patterns = (self.pattern1, self.pattern2, self.pattern3, self.pattern4)
        padded = [F.pad(mosaic, (1 - column, column, 1 - row, row)) for row, column in CELLS]
        x = torch.cat([F.relu(pattern(p)) for pattern, p in zip(patterns, padded, strict=True)], dim=1)
        weights = torch.sigmoid(self.conv(x.mean(dim=(-2, -1))[:, None]))
        return x * weights[:, 0, :, None, None]


class CrossBranchGate(nn.Module):
    """Multiplies each pixel and channel of each branch by a weight in [0, 1] that depends on all branches."""

    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv2d(len(BRANCHES) * CHANNELS, CHANNELS, 1)
        self.conv2 = nn.Conv2d(CHANNELS, CHANNELS, 4, stride=2, padding=1)
        self.conv3 = nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1)
        self.conv4 = nn.Conv2d(CHANNELS, len(BRANCHES) * CHANNELS, 1)

    def forward(self, branches: list[Tensor]) -> tuple[Tensor, ...]:
        """Return the weighted branches."""
        x = torch.cat(branches, dim=1)
        narrow = F.relu(self.conv1(x))
        coarse = F.relu(self.conv3(F.max_pool2d(F.relu(self.conv2(narrow)), GATE_POOL)))
        around = F.interpolate(coarse, size=x.shape[-2:], mode="bilinear", align_corners=True)
        return (x * torch.sigmoid(self.conv4(narrow + around))).chunk(len(BRANCHES), dim=1)


def interleaved(channels: Float[Tensor, "*b 4 c h w"]) -> Float[Tensor, "*b c 2*h 2*w"]:
    """Interleave images behind polarizers at 0, 45, 90 and 135 degrees into one mosaic 90 45 / 135 0."""
    rows = [torch.stack([channels[..., angle // 45, :, :, :] for angle in row], dim=-1) for row in MOSAIC]
    cells = torch.stack(rows, dim=-3)  # c, h, 2 rows, w, 2 columns
    return cells.flatten(-2, -1).flatten(-3, -2)


def coded_aolp(aolp: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Code AoLP as E2P's training target: -90 to 90 degrees become 0 to 1."""
    return torch.remainder(aolp / math.pi + 0.5, 1.0)


def decoded_aolp(code: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Invert `coded_aolp`: radians in [0, pi) for any code."""
    angle = math.pi * torch.remainder(code - 0.5, 1.0)
    return torch.where(angle >= math.pi, 0.0, angle)


def angle_of(maps: Float[Tensor, "*b maps h w"]) -> Float[Tensor, "*b h w"]:
    """AoLP in radians, [0, pi), from the maps of one window: coded, or as sine and cosine of twice the angle."""
    if maps.shape[-3] == len(BRANCHES):
        return decoded_aolp(maps[..., 1, :, :])
    sine, cosine = maps[..., 1, :, :], maps[..., 2, :, :]
    return aolp(torch.stack([torch.ones_like(sine), cosine, sine], dim=-3))
