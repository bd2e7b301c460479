"""FireNet: intensity from events, with 37,777 parameters (Scheerlinck et al., WACV 2020).

`FireNet.load` reads the published checkpoints of FireNet and of FireNet+ (Stoffregen et al., ECCV 2020).
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from polarnet.networks.base.firenet_layers import ConvGRU, ResidualBlock
from polarnet.networks.base.published import PublishedNetwork

CHANNELS = 16
MIDDLE_INTENSITY = 0.25  # initial bias of the output: a polarizer passes half of S0 = 0.5
PUBLISHED_NAMES = {
    "head.conv.conv2d": "head.conv2d",
    "head.recurrent_block": "G1",
    "resblocks.0.conv": "R1",
    "resblocks.0.recurrent_block": "G2",
    "resblocks.1": "R2",
}


class FireNet(PublishedNetwork):
    """conv - ConvGRU - residual - ConvGRU - residual - 1x1 conv at full resolution, without output activation.

    The input is a voxel grid of one channel, normalised by `normalise_nonzero` for FireNet, unnormalised for FireNet+.
    """

    label = "FireNet"
    first_layer = "head.conv2d.weight"

    def __init__(self, bins: int):
        super().__init__(bins)
        self.head = Convolution(bins, CHANNELS, kernel_size=3)
        self.G1 = ConvGRU(CHANNELS)
        self.R1 = ResidualBlock(CHANNELS)
        self.G2 = ConvGRU(CHANNELS)
        self.R2 = ResidualBlock(CHANNELS)
        self.pred = Convolution(CHANNELS, 1, kernel_size=1)
        assert self.pred.conv2d.bias is not None
        nn.init.constant_(self.pred.conv2d.bias, MIDDLE_INTENSITY)

    def forward(
        self, voxels: Float[Tensor, "b bins h w"], state: list[Tensor] | None = None
    ) -> tuple[Float[Tensor, "b h w"], list[Tensor]]:
        """Return the unclamped intensity at the end of one window, and the next state; `state` is None at the start."""
        self.check_bins(voxels)
        before1, before2 = state or (None, None)
        x = self.head(voxels.contiguous(memory_format=torch.channels_last)).relu_()
        after1 = self.G1(x, before1)
        after2 = self.G2(self.R1(after1), before2)
        intensity = self.pred(self.R2(after2))
        return intensity[:, 0].float(), [after1, after2]

    @classmethod
    def own_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rename FireNet's tensors, whose names hold the block of E2VID's code that each layer was in.

        FireNet+ uses our names.
        """
        return {_own_name(name): tensor for name, tensor in tensors.items()}


class Convolution(nn.Module):
    """Convolution that keeps height and width."""

    def __init__(self, inputs: int, outputs: int, kernel_size: int):
        super().__init__()
        self.conv2d = nn.Conv2d(inputs, outputs, kernel_size, padding=kernel_size // 2)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        """Return d channels of the same height and width."""
        return self.conv2d(x)


def _own_name(name: str) -> str:
    name = name.removeprefix("net.")
    for theirs, ours in PUBLISHED_NAMES.items():
        if name.startswith(theirs):
            return ours + name.removeprefix(theirs)
    return name
