"""CISTA-TC: intensity from events by unrolled sparse coding (Liu, Dragotti, ICASSP 2022; file cista_tc.pth.tar)."""

import functools
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.published import PublishedNetwork
from polarnet.networks.e2v.network import Recurrent, convolution, reflected

CHANNELS = 64  # features at half resolution
ATOMS = 128  # channels of the sparse code
ITERATIONS = 5
reflecting = functools.partial(convolution, size=3, padding_mode="reflect")


class CistaState(NamedTuple):
    """Recurrent state, passed from one window to the next."""

    image: Float[Tensor, "b 1 h w"]
    """Image of the previous window, at the padded size."""
    code: Float[Tensor, "b 128 i j"]
    """Sparse code of the previous window, at half resolution."""
    memory: tuple[Tensor, Tensor] | None
    """State of the ConvLSTM; None at the start."""


class CistaTc(PublishedNetwork):
    """Iterative soft thresholding with a learned dictionary and a pull towards the previous window's code.

    The input is a voxel grid of one channel, normalised by `normalise_nonzero`. Layers have the names of the published
    file. All five iterations share one block, which the published file stores five times.
    """

    label = "CISTA-TC"
    first_layer = "We.conv2d.weight"

    def __init__(self, bins: int):
        super().__init__(bins)
        self.We = reflecting(bins, CHANNELS // 2)
        self.Wi = reflecting(1, CHANNELS // 2)
        self.W0 = reflecting(CHANNELS, CHANNELS, stride=2)
        self.P0 = reflecting(CHANNELS, ATOMS)
        self.one_conv_for_prev = reflecting(ATOMS, 1)
        self.one_conv_for_cur = reflecting(ATOMS, 1)
        self.alpha = nn.ParameterList(torch.ones(1, ATOMS, 1, 1) for _ in range(ITERATIONS))
        block = Iteration()
        self.lista_blocks = nn.ModuleList(block for _ in range(ITERATIONS))
        self.Dg = Recurrent(reflecting(ATOMS, CHANNELS, relu=True), CHANNELS, "reflect")
        self.upsamp_conv = reflecting(CHANNELS, CHANNELS)
        self.final_conv = reflecting(CHANNELS, 1)

    def forward(
        self, voxels: Float[Tensor, "b bins h w"], state: CistaState | None = None
    ) -> tuple[Float[Tensor, "b h w"], CistaState]:
        """Return the intensity in [0, 1] at the end of one window, and the next state; `state` is None at the start."""
        top, left, padded = reflected(voxels)
        image = torch.zeros_like(padded[:, :1]) if state is None else state.image
        features = self.W0(torch.cat([self.We(padded), self.Wi(image.to(padded.dtype))], dim=1))
        code = self.P0(features)
        before = torch.zeros_like(code) if state is None else state.code.to(code.dtype)
        attended = self.one_conv_for_prev(before)
        for alpha, block in zip(self.alpha, self.lista_blocks, strict=True):
            weight = torch.sigmoid(attended * self.one_conv_for_cur(code))
            code = block(code, features, weight * alpha * (before - code))
        memory = self.Dg(code, None if state is None else state.memory)
        upsampled = F.interpolate(memory[0], scale_factor=2, mode="bilinear", align_corners=False)
        image = torch.sigmoid(self.final_conv(self.upsamp_conv(upsampled)).float())
        height, width = voxels.shape[-2:]
        return image[:, 0, top : top + height, left : left + width], CistaState(image, code, memory)


class Iteration(nn.Module):
    """One step of soft thresholding: code <- shrink(code + P(features - D(code)) + pull, Lambda)."""

    def __init__(self) -> None:
        super().__init__()
        self.D = reflecting(ATOMS, CHANNELS)
        self.P = reflecting(CHANNELS, ATOMS)
        self.Lambda = nn.Parameter(torch.full((1, ATOMS, 1, 1), 1e-3))

    def forward(
        self, code: Float[Tensor, "b 128 h w"], features: Float[Tensor, "b 64 h w"], pull: Float[Tensor, "b 128 h w"]
    ) -> Float[Tensor, "b 128 h w"]:
        """Return the next code."""
        x = self.P(features - self.D(code)) + code + pull
        return F.relu(x - self.Lambda) - F.relu(-x - self.Lambda)  # trained values of Lambda can be negative
