"""Expected squared error of DoLP: the exponential of a quadratic function of four features.

The redundancy's candidates disagree where the scene is poorly known. DoLP is bounded, so middle values can have larger
errors. Without events there is no evidence. A fit after training (`polarnet.training.engine.calibration`) gives the
coefficients.
"""

from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor, nn

from polarnet.networks.base.blocks import enlarged
from polarnet.networks.polarnet.redundancy import block_means

BASIC = 4
FEATURES = BASIC + BASIC * (BASIC + 1) // 2  # basic ones, their squares and products
MIN_DISAGREEMENT = 1e-3  # squared DoLP, added because candidates that agree may share an error
USUAL_DISAGREEMENT = 0.007  # squared DoLP; features near 0 are less collinear with their squares and products
USUAL_ROOM = 0.17  # the same for the room for errors
MIN_WEIGHT = 1e-6  # lower limit of the candidates' total weight
MIN_ROOM = 0.05  # added to dolp * (1 - dolp)
UNFITTED = -4.0  # log-variance before the fit, for an error of 0.14
LITTLE_EVIDENCE = 0.1  # mean evidence of a frame with a silence of 1/2


class ExpectedError(nn.Module):
    """Log-variance of DoLP's error at half resolution: weight @ features + bias, `UNFITTED` everywhere until fitted."""

    weight: Float[Tensor, " k"]
    bias: Float[Tensor, ""]

    def __init__(self):
        super().__init__()
        self.register_buffer("weight", torch.zeros(FEATURES))
        self.register_buffer("bias", torch.tensor(UNFITTED))

    def forward(self, features: Float[Tensor, "n k h w"]) -> Float[Tensor, "n 1 h w"]:
        """Return the log-variance for features from `error_features`."""
        return (self.weight.view(-1, 1, 1) * features).sum(1, keepdim=True) + self.bias


@torch.no_grad()
def error_features(
    candidates: Float[Tensor, "n c h w"],
    weights: Float[Tensor, "n c h w"],
    evidence: Float[Tensor, "n c h w"],
    dolp: Float[Tensor, "n 1 4*h 4*w"],
) -> Float[Tensor, "n k 2*h 2*w"]:
    """Compute features of the errors of `dolp` at half its resolution; the candidates are at quarter resolution.

    The four basic features are the log of the weighted variance of the candidates' DoLP, its mean over the frame, the
    lack of evidence in the frame (silence, from 0 to 1), and the log of the room for errors, dolp * (1 - dolp). Their
    squares and products follow.
    """
    total = weights.sum(1, keepdim=True).clamp(min=MIN_WEIGHT)
    mean = (weights * candidates).sum(1, keepdim=True) / total
    variance = (weights * (candidates - mean).square()).sum(1, keepdim=True) / total
    disagreement = torch.log((variance + MIN_DISAGREEMENT) / USUAL_DISAGREEMENT)
    silence = 1 / (1 + evidence.mean((1, 2, 3)) / LITTLE_EVIDENCE)
    bounded = block_means(dolp, 2).clamp(0, 1)
    room = torch.log((bounded * (1 - bounded) + MIN_ROOM) / USUAL_ROOM)
    of_frame = [disagreement.mean((-1, -2), keepdim=True), silence[:, None, None, None]]
    basic = [enlarged(disagreement, 2), *(one.expand_as(room) for one in of_frame), room]
    return torch.cat([*basic, *(a * b for a, b in combinations_with_replacement(basic, 2))], dim=1)
