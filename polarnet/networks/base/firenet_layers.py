"""Recurrent and residual layers of FireNet, which E2P shares, under the authors' names."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class ConvGRU(nn.Module):
    """Convolutional gated recurrent unit.

    reset, update = sigmoid(conv[x, h]);  candidate = tanh(conv[x, reset * h]);  h <- h + update * (candidate - h).
    """

    def __init__(self, channels: int):
        super().__init__()
        self.reset_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.update_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.out_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"], state: Float[Tensor, "b c h w"] | None) -> Float[Tensor, "b c h w"]:
        """Return the new state; a `state` of None (at the start) counts as zeros."""
        state = torch.zeros_like(x) if state is None else state.to(x.dtype)
        both = torch.cat([x, state], dim=1)
        reset, update = self.reset_gate(both).sigmoid_(), self.update_gate(both).sigmoid_()
        candidate = self.out_gate(torch.cat([x, reset * state], dim=1)).tanh_()
        return torch.lerp(state, candidate, update)


class ResidualBlock(nn.Module):
    """Residual block relu(x + conv(relu(conv(x))))."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return a tensor of the same shape."""
        return self.conv2(self.conv1(x).relu_()).add_(x).relu_()
