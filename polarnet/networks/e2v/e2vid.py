"""E2VID: intensity from events, with 10,712,098 parameters (Rebecq et al., CVPR 2019 and TPAMI 2021).

This is the network of the published "lightweight" checkpoint. `E2vid.load` reads the file E2VID_lightweight.pth.tar.
"""

import itertools
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.published import PublishedNetwork

HEAD_CHANNELS = 32
ENCODER_CHANNELS = (64, 128, 256)
RESIDUAL_BLOCKS = 2
SIZE_MULTIPLE = 2 ** len(ENCODER_CHANNELS)  # each encoder halves height and width
PUBLISHED_ARCH = "E2VIDRecurrent"
PUBLISHED_PREFIX = "unetrecurrent."
PUBLISHED_SETTINGS = {
    "skip_type": "sum",
    "recurrent_block_type": "convlstm",
    "num_encoders": len(ENCODER_CHANNELS),
    "base_num_channels": HEAD_CHANNELS,
    "num_residual_blocks": RESIDUAL_BLOCKS,
    "norm": "BN",
    "use_upsample_conv": False,
}


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
        self.head = Convolution(bins, HEAD_CHANNELS, 5, normalised=False)
        self.encoders = nn.ModuleList(RecurrentEncoder(inputs, outputs) for inputs, outputs in steps)
        self.resblocks = nn.ModuleList(ResidualBlock(sizes[-1]) for _ in range(RESIDUAL_BLOCKS))
        self.decoders = nn.ModuleList(Decoder(inputs, outputs) for outputs, inputs in reversed(steps))
        self.pred = Convolution(HEAD_CHANNELS, 1, 1, normalised=True, relu=False)

    def forward(
        self, voxels: Float[Tensor, "b bins h w"], state: Sequence[Tensor] | None = None
    ) -> tuple[Float[Tensor, "b h w"], list[Tensor]]:
        """Return the intensity at the end of one window, and the next state; `state` is None at the start.

        The input is padded by reflection to multiples of 8, and the result is cropped to the original size.
        """
        self.check_bins(voxels)
        top, left, padded = reflected(voxels)
        head = self.head(padded.contiguous(memory_format=torch.channels_last))
        x, skips, after = head, [], []
        for i, encoder in enumerate(self.encoders):
            x, memory = encoder(x, None if state is None else (state[2 * i], state[2 * i + 1]))
            skips.append(x)
            after += [x, memory]
        for block in self.resblocks:
            x = block(x)
        for decoder, skip in zip(self.decoders, reversed(skips), strict=True):
            x = decoder(x + skip)
        intensity = torch.sigmoid(self.pred(x + head).float())
        height, width = voxels.shape[-2:]
        return intensity[:, 0, top : top + height, left : left + width], after

    @classmethod
    def published_tensors(cls, path: str | os.PathLike[str], content: Mapping[str, Any]) -> Mapping[str, Tensor]:
        """Check the network settings in the file as well, because several versions of E2VID share tensor names."""
        if "state_dict" not in content:
            raise ValueError(f"{path} holds no E2VID: expected a dictionary with arch, model and state_dict")
        if content.get("arch", PUBLISHED_ARCH) != PUBLISHED_ARCH:
            raise ValueError(f"{path} holds no E2VID: its arch is {content['arch']!r}, expected {PUBLISHED_ARCH!r}")
        settings = content.get("model") or content.get("config", {}).get("model", {})
        for key, expected in PUBLISHED_SETTINGS.items():
            if key in settings and settings[key] != expected:
                raise ValueError(
                    f"{path} holds another E2VID: its {key} is {settings[key]!r}, expected {expected!r}; "
                    f"the published file is E2VID_lightweight.pth.tar"
                )
        return content["state_dict"]

    @classmethod
    def own_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Remove the authors' prefix."""
        return {name.removeprefix(PUBLISHED_PREFIX): tensor for name, tensor in tensors.items()}


class Convolution(nn.Module):
    """Convolution, optional batch normalisation (which replaces the bias), optional ReLU."""

    def __init__(
        self, inputs: int, outputs: int, kernel_size: int, *, normalised: bool, stride: int = 1, relu: bool = True
    ):
        super().__init__()
        self.conv2d = nn.Conv2d(inputs, outputs, kernel_size, stride, padding=kernel_size // 2, bias=not normalised)
        self.norm_layer = nn.BatchNorm2d(outputs) if normalised else None
        self.relu = relu

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d i j"]:
        """Return d channels, downsampled by the stride."""
        x = self.conv2d(x)
        if self.norm_layer is not None:
            x = self.norm_layer(x)
        return F.relu(x) if self.relu else x


class RecurrentEncoder(nn.Module):
    """Downsampling by 2 with a 5x5 convolution, then a ConvLSTM."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.conv = Convolution(inputs, outputs, 5, normalised=True, stride=2)
        self.recurrent_block = ConvLstm(outputs)

    def forward(
        self, x: Float[Tensor, "b c h w"], state: tuple[Tensor, Tensor] | None
    ) -> tuple[Float[Tensor, "b d i j"], Float[Tensor, "b d i j"]]:
        """Return the LSTM's output and its memory."""
        return self.recurrent_block(self.conv(x), state)


class ConvLstm(nn.Module):
    """Convolutional LSTM with the gates i, f, o = sigmoid and g = tanh of conv[x, output].

    memory <- f memory + i g;  output <- o tanh(memory)
    """

    def __init__(self, channels: int):
        super().__init__()
        self.Gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1)

    def forward(
        self, x: Float[Tensor, "b c h w"], state: tuple[Tensor, Tensor] | None
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b c h w"]]:
        """Return the output and the memory; a `state` of None (at the start) counts as zeros."""
        output, memory = (torch.zeros_like(x), torch.zeros_like(x)) if state is None else state
        i, f, o, g = self.Gates(torch.cat([x, output.to(x.dtype)], dim=1)).chunk(4, dim=1)
        memory = torch.sigmoid(f) * memory.to(f.dtype) + torch.sigmoid(i) * torch.tanh(g)
        return torch.sigmoid(o) * torch.tanh(memory), memory


class ResidualBlock(nn.Module):
    """Residual block relu(x + bn(conv(relu(bn(conv(x))))))."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return a tensor of the same shape."""
        return F.relu(x + self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x))))))


class Decoder(nn.Module):
    """Upsampling by 2 with a transposed 5x5 convolution."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.transposed_conv2d = nn.ConvTranspose2d(
            inputs, outputs, 5, stride=2, padding=2, output_padding=1, bias=False
        )
        self.norm_layer = nn.BatchNorm2d(outputs)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d 2*h 2*w"]:
        """Return d channels at twice the height and width."""
        return F.relu(self.norm_layer(self.transposed_conv2d(x)))


def reflected(images: Float[Tensor, "b c h w"]) -> tuple[int, int, Float[Tensor, "b c i j"]]:
    """Pad images by reflection to multiples of 8; return the rows added above, columns added left, and images."""
    rows, columns = (-side % SIZE_MULTIPLE for side in images.shape[-2:])
    top, left = math.ceil(rows / 2), math.ceil(columns / 2)
    return top, left, F.pad(images, (left, columns - left, top, rows - top), mode="reflect")
