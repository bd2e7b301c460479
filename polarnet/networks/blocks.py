"""Layers of the networks that are not Swin transformer blocks. Images are kept channels_last, the layout CPUs prefer.

Recurrent layers take a whole run of windows at once: "n" counts images, time-major (n = windows * batch), so that
everything but the recurrence itself is one large operation.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


def contrasts(events: Float[Tensor, "*b c h w"]) -> Float[Tensor, "*b c h w"]:
    """(e0 + e45 + e90 + e135) / 2, e0 - e90, e45 - e135 and (e0 + e90) - (e45 + e135) of the polarizers' tensors.

    Unpolarized light drives the four alike, and far more than polarization sets them apart: given them as they are, a
    network first has to find the differences. The last one is no copy of the others:
    events tell of log intensities, for which I0 + I90 = I45 + I135 does not hold as it stands.
    """
    e0, e45, e90, e135 = events.unflatten(-3, (4, -1)).unbind(-4)
    return torch.cat([(e0 + e45 + e90 + e135) / 2, e0 - e90, e45 - e135, (e0 + e90) - (e45 + e135)], dim=-3)


def compressed(x: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """sign(x) log(1 + |x|): a pixel with many events reaches tens, while most of what matters is below one."""
    return torch.sign(x) * torch.log1p(x.abs())


def conv3x3(inputs: int, outputs: int, bias: bool = True) -> nn.Conv2d:
    """A 3x3 convolution, stride 1, that keeps height and width."""
    return nn.Conv2d(inputs, outputs, kernel_size=3, padding=1, bias=bias)


def on_blocks(layer: nn.Conv2d, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d h/2 w/2"]:
    """layer(pixel_unshuffle(x, 2)) of a `conv3x3`, as one 6x6 convolution: the shuffled copy would cost more."""
    weight = layer.weight.unflatten(1, (-1, 2, 2))  # d, c, row and column in a block, row and column of the block
    weight = weight.permute(0, 1, 4, 2, 5, 3).flatten(4, 5).flatten(2, 3)
    return F.conv2d(x, weight.contiguous(memory_format=torch.channels_last), layer.bias, stride=2, padding=2)


class ConvGRU(nn.Module):
    """Convolutional gated recurrent unit (Ballas et al., ICLR 2016), all its convolutions 3x3.

    reset, update = sigmoid(W x + U h);  candidate = tanh(W x + U (reset * h));  h <- h + update * (candidate - h).
    The three W are one convolution over all windows at once; only the U run window by window.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.channels = channels
        self.from_input = conv3x3(channels, 3 * channels)
        self.from_state = conv3x3(channels, 2 * channels, bias=False)
        self.from_reset_state = conv3x3(channels, channels, bias=False)

    def forward(
        self, x: Float[Tensor, "n c h w"], state: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "b c h w"]]:
        """The state after each of the n / b windows, and the last of them again, to carry on from."""
        channels = state.shape[1]
        states = []
        for inputs in self.from_input(x).split(len(state)):
            gates_in, candidate_in = inputs.split([2 * channels, channels], dim=1)
            reset, update = torch.sigmoid(gates_in + self.from_state(state)).chunk(2, dim=1)
            candidate = torch.tanh(candidate_in + self.from_reset_state(reset * state))
            state = torch.lerp(state.to(candidate.dtype), candidate, update)
            states.append(state)
        return torch.cat(states), state


class ResidualBlock(nn.Module):
    """relu(x + conv(relu(conv(x)))), 3x3, stride 1 (He et al., CVPR 2016), without normalisation."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = conv3x3(channels, channels)
        self.second = conv3x3(channels, channels)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """The same shape."""
        return F.relu(x + self.second(F.relu(self.first(x))))


class UpBlock(nn.Module):
    """Twice the size: a 1x1 convolution to the skip's channels, enlarged bilinearly, plus the skip, a 3x3 convolution.

    The skip is added, not set beside: half the convolution's work, and it is the largest image of the network.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.narrow = nn.Conv2d(inputs, outputs, kernel_size=1)
        self.smooth = conv3x3(outputs, outputs)

    def forward(self, x: Float[Tensor, "n c h2 w2"], skip: Float[Tensor, "n d h w"]) -> Float[Tensor, "n d h w"]:
        """`skip` has the channels and the size of the result: twice that of x, or a row or column less."""
        height, width = skip.shape[-2:]
        enlarged = F.interpolate(self.narrow(x), scale_factor=2, mode="bilinear")
        return F.relu(self.smooth(enlarged[..., :height, :width] + skip))


class Level(nn.Module):
    """A recurrent U-Net from one of its sizes down: what an image gets from itself seen at half the size, and smaller.

    `channels` are those at a half of the size, a quarter, and so on, one recurrent layer each. Each level sees twice as
    far as the one above it, at a quarter of its cost.
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
        self, x: Float[Tensor, "n c h w"], states: Sequence[Tensor]
    ) -> tuple[Float[Tensor, "n c h w"], list[Tensor]]:
        """n windows of the streams whose recurrent layers hold `states`, and the states after the last window."""
        height, width = x.shape[-2:]
        halved = self.down(F.pad(x, (0, width % 2, 0, height % 2), mode="replicate"))
        y, state = self.gru(self.before(F.relu(halved)), states[0])
        others: list[Tensor] = []
        if self.smaller is not None:
            y, others = self.smaller(y, states[1:])
        return self.up(self.after(y), skip=x), [state, *others]

    def initial_states(self, x: Float[Tensor, "n c h w"]) -> list[Tensor]:
        """Zeros, for images of the size of `x`."""
        height, width = (-(-size // 2) for size in x.shape[-2:])
        own = x.new_zeros(len(x), height, width, self.gru.channels).permute(0, 3, 1, 2)
        return [own, *(self.smaller.initial_states(own) if self.smaller is not None else [])]
