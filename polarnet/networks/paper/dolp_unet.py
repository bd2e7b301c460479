"""The paper's end-to-end DoLP recovery network (section 3.3, Fig. 6)."""

from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import Field, PositiveInt
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.blocks import ConvGRU, ResidualBlock, UpBlock, conv3x3
from polarnet.networks.paper.swin import SwinStage
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction

STRIDE = 4  # two stages halve the resolution; height and width are padded to multiples of 4
MIDDLE_DOLP = 0.5  # initial bias of the output; DoLP lies in [0, 1]


@section
class DolpUNetConfig:
    """Section `networks.paper` of params.yaml."""

    channels: list[Annotated[int, Field(gt=0, le=1024)]]
    """Channels of C1; of S1 and G1; of S2, G2, R1 and R2. The paper has 32, 64, 128."""
    swin_depth: Annotated[int, Field(gt=0, le=100)]
    """Blocks per stage; every second block has shifted tiles."""
    swin_window: Annotated[int, Field(ge=2, le=256)]
    """Side of an attention tile in pixels."""
    swin_heads: list[PositiveInt]
    """Attention heads of S1 and S2."""
    residual_blocks: Annotated[int, Field(ge=0, le=100)]
    """Number of residual blocks; the paper has two, R1 and R2."""

    def __post_init__(self):
        if len(self.channels) != 3 or len(self.swin_heads) != 2:
            raise ValueError(f"channels, swin_heads: expected 3 and 2 numbers, got {self.channels}, {self.swin_heads}")
        for channels, heads in zip(self.channels[1:], self.swin_heads, strict=True):
            if channels % heads:
                raise ValueError(f"swin_heads: expected a divisor of {channels} channels, got {heads}")

    @property
    def network_class(self) -> type[Any]:
        """Class of the network with these settings."""
        return DolpUNet


class DolpUNet(nn.Module):
    """The paper's recurrent network from event tensors of four channels to DoLP.

    The output is linear, so that gradients do not vanish near 0 or 1; code that scores or displays it clamps it.
    """

    representation = "event_tensor"
    predicts_stokes = False
    optimizer = "adam"
    outputs = ("p1",)

    def __init__(self, config: DolpUNetConfig, in_channels: int = 4):
        super().__init__()
        full, half, quarter = config.channels
        depth, window, (heads_half, heads_quarter) = config.swin_depth, config.swin_window, config.swin_heads
        self.c1 = conv3x3(in_channels, full)
        self.s1 = SwinStage(full, half, depth, heads_half, window)
        self.g1 = ConvGRU(half)
        self.s2 = SwinStage(half, quarter, depth, heads_quarter, window)
        self.g2 = ConvGRU(quarter)
        self.r = nn.Sequential(*(ResidualBlock(quarter) for _ in range(config.residual_blocks)))
        self.d2 = UpBlock(quarter, half)
        self.d1 = UpBlock(half, full)
        self.p1 = nn.Conv2d(full, 1, kernel_size=1)
        assert self.p1.bias is not None
        nn.init.constant_(self.p1.bias, MIDDLE_DOLP)

    def forward(
        self, inputs: Float[Tensor, "b c h w"], state: list[Tensor] | None = None
    ) -> tuple[Prediction, list[Tensor]]:
        """Process one window of b streams. `state` comes from the previous window; None at the start."""
        prediction, state = self.unroll(inputs[None], state)
        return Prediction(prediction.dolp[0]), state

    def unroll(
        self, inputs: Float[Tensor, "t b c h w"], state: list[Tensor] | None = None
    ) -> tuple[Prediction, list[Tensor]]:
        """Process t windows of b streams at once: same result as `forward` per window, in fewer operations."""
        t, b, _, height, width = inputs.shape
        x = inputs.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        x = F.pad(x, (0, -width % STRIDE, 0, -height % STRIDE))  # the padding holds no events
        state1, state2 = state or (None, None)

        c1 = F.relu(self.c1(x))
        g1, state1 = self.g1(self.s1(c1), b, state1)
        g2, state2 = self.g2(self.s2(g1), b, state2)
        d2 = self.d2(self.r(g2), skip=g1)
        dolp = self.p1(self.d1(d2, skip=c1))
        dolp = dolp[:, 0, :height, :width].float().unflatten(0, (t, b))
        return Prediction(dolp), [state1, state2]
