"""FireNet: intensity from events, with 37,777 parameters (Scheerlinck et al., WACV 2020).

`FireNet.load` reads the published checkpoints of FireNet and of FireNet+ (Stoffregen et al., ECCV 2020).
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from polarnet.networks.base.published import ConvGRU, PublishedNetwork, ResidualBlock
from polarnet.networks.e2v.e2vid import convolution

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
        self.head = convolution(bins, CHANNELS, 3, relu=True)
        self.G1 = ConvGRU(CHANNELS)
        self.R1 = ResidualBlock(CHANNELS)
        self.G2 = ConvGRU(CHANNELS)
        self.R2 = ResidualBlock(CHANNELS)
        self.pred = convolution(CHANNELS, 1, 1)
        nn.init.constant_(self.pred.get_parameter("conv2d.bias"), MIDDLE_INTENSITY)

    def forward(
        self, voxels: Float[Tensor, "b bins h w"], state: list[Tensor] | None = None
    ) -> tuple[Float[Tensor, "b h w"], list[Tensor]]:
        """Return the unclamped intensity at the end of one window, and the next state; `state` is None at the start."""
        before1, before2 = state or (None, None)
        after1 = self.G1(self.head(voxels.contiguous(memory_format=torch.channels_last)), before1)
        after2 = self.G2(self.R1(after1), before2)
        intensity = self.pred(self.R2(after2))
        return intensity[:, 0].float(), [after1, after2]

    @classmethod
    def own_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rename FireNet's tensors, named after the blocks of E2VID's code; FireNet+ uses our names."""
        return {_own_name(name.removeprefix("net.")): tensor for name, tensor in tensors.items()}


def _own_name(name: str) -> str:
    theirs = next((theirs for theirs in PUBLISHED_NAMES if name.startswith(theirs)), "")
    return PUBLISHED_NAMES.get(theirs, "") + name.removeprefix(theirs)
