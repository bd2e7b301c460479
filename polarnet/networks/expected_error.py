"""How large DoLP's errors are expected to be, by a few things that tell it on pictures never seen.

Where the redundancy's answers disagree it is badly known what the scene is like; DoLP is bounded, so errors of middle
values can be larger; few events say little, and none nothing at all. What is expected is the exponential of a linear
function of these, with a handful of coefficients, which are found when a training is over
(`polarnet.training.calibration`).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.redundancy import block_means

TELLING = 5
LEAST_DISAGREEMENT = 1e-3  # squared DoLP: candidates that agree are wrong together
LEAST_WEIGHT = 1e-6  # of all candidates together
LEAST_ROOM = 0.05  # of dolp * (1 - dolp)
HARDLY_ANY = 0.1  # evidence, the mean over a frame


class ExpectedError(nn.Module):
    """What the logarithm of the squared error is above the network's start, of a pixel of half the size: weight @ what
    tells it + bias.

    Nothing is learnt while a network trains: all is 0 until `polarnet.training.loop.calibrate`.
    """

    weight: Float[Tensor, " k"]
    bias: Float[Tensor, ""]

    def __init__(self):
        super().__init__()
        self.register_buffer("weight", torch.zeros(TELLING))
        self.register_buffer("bias", torch.zeros(()))

    def forward(self, telling: Float[Tensor, "n k h w"]) -> Float[Tensor, "n 1 h w"]:
        """Of what `telling` gives."""
        return (self.weight.view(-1, 1, 1) * telling).sum(1, keepdim=True) + self.bias


@torch.no_grad()
def telling(
    candidates: Float[Tensor, "n c h w"],
    weights: Float[Tensor, "n c h w"],
    evidence: Float[Tensor, "n c h w"],
    dolp: Float[Tensor, "n 1 4*h 4*w"],
) -> Float[Tensor, "n k 2*h 2*w"]:
    """What tells how large the errors of `dolp` are, at half its size; the candidates are at a quarter of it.

    The logarithm of how far the candidates' DoLP are apart, by their weights, and that of the evidence they rest on;
    the mean of the first over the frame, and from 0 to 1 how little evidence there is in it; the logarithm of what room
    errors have.
    """
    whole = weights.sum(1, keepdim=True).clamp(min=LEAST_WEIGHT)
    mean = (weights * candidates).sum(1, keepdim=True) / whole
    apart = (weights * (candidates - mean).square()).sum(1, keepdim=True) / whole
    apart = torch.log(apart + LEAST_DISAGREEMENT)
    at_place = torch.cat([apart, torch.log1p(evidence).mean(1, keepdim=True)], dim=1)
    silence = 1 / (1 + evidence.mean((1, 2, 3)) / HARDLY_ANY)
    of_frame = [apart.mean((-1, -2), keepdim=True), silence[:, None, None, None]]
    bounded = block_means(dolp, 2).clamp(0, 1)
    room = torch.log(bounded * (1 - bounded) + LEAST_ROOM)
    fine = F.interpolate(at_place, scale_factor=2, mode="bilinear")
    return torch.cat([fine, *(one.expand_as(room) for one in of_frame), room], dim=1)
