"""Convolutional and recurrent layers of the networks. Images are channels_last, the fastest layout on CPUs.

Recurrent layers process a run of windows in one call. The axis n holds all images, time-major (n = windows * batch), so
everything except the recurrence is one large operation.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


def contrasts(events: Float[Tensor, "*b c h w"]) -> Float[Tensor, "*b c h w"]:
    """Return (e0 + e45 + e90 + e135) / 2, e0 - e90, e45 - e135 and (e0 + e90) - (e45 + e135) of the four channels.

    The common part of the channels is far larger than the differences due to polarization, which a network would first
    have to learn. The last contrast is not redundant: I0 + I90 = I45 + I135 does not hold for logarithms.
    """
    e0, e45, e90, e135 = events.unflatten(-3, (4, -1)).unbind(-4)
    return torch.cat([(e0 + e45 + e90 + e135) / 2, e0 - e90, e45 - e135, (e0 + e90) - (e45 + e135)], dim=-3)


def compressed(x: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Return sign(x) log(1 + |x|). Busy pixels reach tens, whereas most of the information lies below one."""
    return torch.sign(x) * torch.log1p(x.abs())


def enlarged(x: Float[Tensor, "n c h w"], factor: int) -> Float[Tensor, "n c h2 w2"]:
    """Interpolate bilinearly to `factor` times the height and width."""
    return F.interpolate(x, scale_factor=factor, mode="bilinear")


def conv3x3(inputs: int, outputs: int, bias: bool = True) -> nn.Conv2d:
    """Build a 3x3 convolution with stride 1 that keeps height and width."""
    return nn.Conv2d(inputs, outputs, kernel_size=3, padding=1, bias=bias)


def on_blocks(layer: nn.Conv2d, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d h/2 w/2"]:
    """Compute layer(pixel_unshuffle(x, 2)) for a `conv3x3` as one 6x6 convolution, cheaper than the shuffled copy."""
    weight = layer.weight.unflatten(1, (-1, 2, 2))  # d, c, row and column in a block, row and column of the block
    weight = weight.permute(0, 1, 4, 2, 5, 3).flatten(4, 5).flatten(2, 3)
    return F.conv2d(x, weight.contiguous(memory_format=torch.channels_last), layer.bias, stride=2, padding=2)


class ConvGRU(nn.Module):
    """Convolutional gated recurrent unit (Ballas et al., ICLR 2016) with 3x3 convolutions.

    reset, update = sigmoid(W x + U h);  candidate = tanh(W x + U (reset * h));  h <- h + update * (candidate - h).
    The W are one convolution over all windows at once; the U run window by window.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.channels = channels
        self.from_input = conv3x3(channels, 3 * channels)
        self.from_state = conv3x3(channels, 2 * channels, bias=False)
        self.from_reset_state = conv3x3(channels, channels, bias=False)

    def forward(
        self, x: Float[Tensor, "n c h w"], streams: int, state: Float[Tensor, "b c h w"] | None
    ) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "b c h w"]]:
        """Return the states after each of the n / b windows of b `streams`, and the final state for the next call.

        `state` is None at the start, which counts as zeros.
        """
        state, states = torch.zeros_like(x[:streams]) if state is None else state, []
        for inputs in self.from_input(x).split(streams):
            gates_in, candidate_in = inputs.split([2 * self.channels, self.channels], dim=1)
            reset, update = torch.sigmoid(gates_in + self.from_state(state)).chunk(2, dim=1)
            candidate = torch.tanh(candidate_in + self.from_reset_state(reset * state))
            state = torch.lerp(state.to(candidate.dtype), candidate, update)
            states.append(state)
        return torch.cat(states), state


class ResidualBlock(nn.Module):
    """relu(x + conv(relu(conv(x)))) with 3x3 convolutions, stride 1, no normalisation (He et al., CVPR 2016)."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = conv3x3(channels, channels)
        self.second = conv3x3(channels, channels)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Return a tensor of the same shape."""
        return F.relu(x + self.second(F.relu(self.first(x))))


class UpBlock(nn.Module):
    """Upsampling by 2: 1x1 convolution to the skip's channels, bilinear enlargement, skip added, 3x3 convolution.

    Adding the skip instead of concatenating it halves the work of the 3x3 convolution, on the network's largest image.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.narrow = nn.Conv2d(inputs, outputs, kernel_size=1)
        self.smooth = conv3x3(outputs, outputs)

    def forward(self, x: Float[Tensor, "n c h2 w2"], skip: Float[Tensor, "n d h w"]) -> Float[Tensor, "n d h w"]:
        """Return the upsampled image. `skip` has its shape: twice the height and width of x, or one pixel less."""
        height, width = skip.shape[-2:]
        twice = enlarged(self.narrow(x), 2)
        return F.relu(self.smooth(twice[..., :height, :width] + skip))


class Level(nn.Module):
    """Recursive level of a recurrent U-Net: adds features from half the resolution and all lower ones to an image.

    `channels` lists the channels at 1/2, 1/4, ... of the resolution, with one recurrent layer each. Each level has
    twice the field of view of the level above, at a quarter of its cost.
    """

    def __init__(self, above: int, channels: Sequence[int]):
        super().__init__()
        own, *smaller = channels
        self.down = nn.Conv2d(above, own, kernel_size=2, stride=2)
        self.before = ResidualBlock(own)
        self.gru = ConvGRU(own)
        self.smaller = Level(own, smaller) if smaller else None
        self.after = ResidualBlock(own)
        self.up = UpBlock(own, above)

    def forward(
        self, x: Float[Tensor, "n c h w"], streams: int, states: Sequence[Tensor]
    ) -> tuple[Float[Tensor, "n c h w"], list[Tensor]]:
        """Process n / b windows of b `streams`; return the result and the states after the last window.

        `states` come from the previous windows; empty at the start.
        """
        height, width = x.shape[-2:]
        halved = self.down(F.pad(x, (0, width % 2, 0, height % 2), mode="replicate"))
        y, state = self.gru(self.before(F.relu(halved)), streams, states[0] if states else None)
        others: list[Tensor] = []
        if self.smaller is not None:
            y, others = self.smaller(y, streams, states[1:])
        return self.up(self.after(y), skip=x), [state, *others]
