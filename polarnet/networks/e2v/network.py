"""Networks of the E2V baseline, from events to intensity: E2VID and FireNet.

E2VID has 10,712,098 parameters (Rebecq et al., CVPR 2019 and TPAMI 2021), FireNet 37,777 (Scheerlinck et al., WACV
2020). `E2vid.load` reads the authors' "lightweight" checkpoint, E2VID_lightweight.pth.tar; `FireNet.load` those of
FireNet and of FireNet+ (Stoffregen et al., ECCV 2020).
"""

import itertools
import math
import re
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.published import ConvGRU, PublishedNetwork, ResidualBlock

HEAD_CHANNELS = 32
ENCODER_CHANNELS = (64, 128, 256)
RESIDUAL_BLOCKS = 2
Padding = Literal["zeros", "reflect"]
SIZE_MULTIPLE = 2 ** len(ENCODER_CHANNELS)  # each encoder halves height and width
FIRENET_CHANNELS = 16
MIDDLE_INTENSITY = 0.25  # initial bias of FireNet's output: a polarizer passes half of S0 = 0.5
FIRENET_NAMES = {
    "head.conv.conv2d": "head.conv2d",
    "head.recurrent_block": "G1",
    "resblocks.0.conv": "R1",
    "resblocks.0.recurrent_block": "G2",
    "resblocks.1": "R2",
}
"""Our names of FireNet's layers by those of its file, which are those of E2VID's code."""


class E2vid(PublishedNetwork):
    """U-Net with three recurrent encoders (a stride-2 convolution, then a ConvLSTM); the intensity is in [0, 1].

    The input is a voxel grid of one channel, normalised by `normalise_nonzero`. Skip connections are added, not
    concatenated. Layers have the names of the published checkpoint.
    """

    label = "E2VID"
    first_layer = "head.conv2d.weight"

    def __init__(self, bins: int):
        super().__init__(bins)
        sizes = (HEAD_CHANNELS, *ENCODER_CHANNELS)
        steps = list(itertools.pairwise(sizes))
        self.head = convolution(bins, HEAD_CHANNELS, 5, relu=True)
        self.encoders = nn.ModuleList(
            Recurrent(convolution(inputs, outputs, 5, stride=2, normalised=True, relu=True), outputs)
            for inputs, outputs in steps
        )
        self.resblocks = nn.ModuleList(ResidualBlock(sizes[-1], normalised=True) for _ in range(RESIDUAL_BLOCKS))
        self.decoders = nn.ModuleList(decoder(inputs, outputs) for outputs, inputs in reversed(steps))
        self.pred = convolution(HEAD_CHANNELS, 1, 1, normalised=True)

    def forward(
        self, voxels: Float[Tensor, "b bins h w"], state: Sequence[Tensor] | None = None
    ) -> tuple[Float[Tensor, "b h w"], list[Tensor]]:
        """Return the intensity at the end of one window, and the next state; `state` is None at the start."""
        top, left, padded = reflected(voxels)
        head = self.head(padded.contiguous(memory_format=torch.channels_last))
        x, skips, after = head, [], []
        for i, encoder in enumerate(self.encoders):
            x, memory = encoder(x, None if state is None else (state[2 * i], state[2 * i + 1]))
            skips.append(x)
            after += [x, memory]
        for block in self.resblocks:
            x = block(x)
        for decode, skip in zip(self.decoders, reversed(skips), strict=True):
            x = decode(x + skip)
        intensity = torch.sigmoid(self.pred(x + head).float())
        height, width = voxels.shape[-2:]
        return intensity[:, 0, top : top + height, left : left + width], after

    @classmethod
    def own_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Remove the authors' prefix."""
        return {name.removeprefix("unetrecurrent."): tensor for name, tensor in tensors.items()}


class FireNet(PublishedNetwork):
    """conv - ConvGRU - residual - ConvGRU - residual - 1x1 conv at full resolution, without output activation.

    The input is a voxel grid of one channel, normalised by `normalise_nonzero` for FireNet, unnormalised for FireNet+.
    """

    label = "FireNet"
    first_layer = "head.conv2d.weight"

    def __init__(self, bins: int):
        super().__init__(bins)
        self.head = convolution(bins, FIRENET_CHANNELS, 3, relu=True)
        self.G1 = ConvGRU(FIRENET_CHANNELS)
        self.R1 = ResidualBlock(FIRENET_CHANNELS)
        self.G2 = ConvGRU(FIRENET_CHANNELS)
        self.R2 = ResidualBlock(FIRENET_CHANNELS)
        self.pred = convolution(FIRENET_CHANNELS, 1, 1)
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
        theirs = re.compile("|".join(map(re.escape, FIRENET_NAMES)))
        plain = {name.removeprefix("net."): tensor for name, tensor in tensors.items()}
        return {theirs.sub(lambda match: FIRENET_NAMES[match[0]], name): tensor for name, tensor in plain.items()}


def convolution(
    inputs: int, outputs: int, size: int, *, stride: int = 1, normalised: bool = False, relu: bool = False,
    padding_mode: Padding = "zeros",
) -> nn.Sequential:  # fmt: skip
    """Build a convolution, with batch normalisation (which replaces the bias) and ReLU on request."""
    layer = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=not normalised, padding_mode=padding_mode)
    norm = nn.BatchNorm2d(outputs) if normalised else None
    return named(conv2d=layer, norm_layer=norm, relu=nn.ReLU() if relu else None)


def decoder(inputs: int, outputs: int) -> nn.Sequential:
    """Build an upsampling by 2: transposed 5x5 convolution, batch normalisation, ReLU."""
    layer = nn.ConvTranspose2d(inputs, outputs, 5, stride=2, padding=2, output_padding=1, bias=False)
    return named(transposed_conv2d=layer, norm_layer=nn.BatchNorm2d(outputs), relu=nn.ReLU())


def named(**layers: nn.Module | None) -> nn.Sequential:
    """Build a sequence of the layers that are not None, with their published names."""
    return nn.Sequential(OrderedDict((name, layer) for name, layer in layers.items() if layer is not None))


class Recurrent(nn.Module):
    """A convolution, then a ConvLSTM, whose output and memory it returns."""

    def __init__(self, conv: nn.Module, channels: int, padding_mode: Padding = "zeros"):
        super().__init__()
        self.conv = conv
        self.recurrent_block = ConvLstm(channels, padding_mode)

    def forward(
        self, x: Float[Tensor, "b c h w"], state: tuple[Tensor, Tensor] | None
    ) -> tuple[Float[Tensor, "b d i j"], Float[Tensor, "b d i j"]]:
        """Return the LSTM's output and its memory."""
        return self.recurrent_block(self.conv(x), state)


class ConvLstm(nn.Module):
    """Convolutional LSTM with the gates i, f, o = sigmoid and g = tanh of conv[x, output].

    memory <- f memory + i g;  output <- o tanh(memory)
    """

    def __init__(self, channels: int, padding_mode: Padding = "zeros"):
        super().__init__()
        self.Gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1, padding_mode=padding_mode)

    def forward(
        self, x: Float[Tensor, "b c h w"], state: tuple[Tensor, Tensor] | None
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b c h w"]]:
        """Return the output and the memory; a `state` of None (at the start) counts as zeros."""
        output, memory = (torch.zeros_like(x), torch.zeros_like(x)) if state is None else state
        i, f, o, g = self.Gates(torch.cat([x, output.to(x.dtype)], dim=1)).chunk(4, dim=1)
        memory = torch.sigmoid(f) * memory.to(f.dtype) + torch.sigmoid(i) * torch.tanh(g)
        return torch.sigmoid(o) * torch.tanh(memory), memory


def reflected(images: Float[Tensor, "b c h w"]) -> tuple[int, int, Float[Tensor, "b c i j"]]:
    """Pad images by reflection to multiples of 8; return the rows added above, columns added left, and images."""
    rows, columns = (-side % SIZE_MULTIPLE for side in images.shape[-2:])
    top, left = math.ceil(rows / 2), math.ceil(columns / 2)
    return top, left, F.pad(images, (left, columns - left, top, rows - top), mode="reflect")


ARCHITECTURES: dict[str, type[FireNet] | type[E2vid]] = {"firenet": FireNet, "e2vid": E2vid}
"""Networks by name: `baselines.e2v.arch` selects one, and its checkpoint names it."""
