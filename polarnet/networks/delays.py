"""What it says about polarization how late the events of each polarizer come, where nothing else says anything.

A pixel's photoreceptor answers the more slowly the less light falls on it: its bandwidth grows with intensity (v2e, Hu
et al. 2021; `cutoff_hz` of the emulator). So behind the polarizer that lets less light through, the same change is seen
later. Where all of a scene is polarized alike, this is what is left: the differences of polarizers that the redundancy
needs (`polarnet.networks.redundancy`) are all 0 there, whatever DoLP is.

With e the mean of the four polarizers' changes and A = e0 - e90, a delay of e90 against e0 shows in the sum over time
of A(t-1) e(t) - A(t) e(t-1), t in parts of a window. Where A = a e for any a, without delay, the sum is 0 but for its
two ends. Where the scene's polarization varies, A is no multiple of e, and what a moving pattern leaves in the sum is
no delay: there the redundancy knows better. `Delays` therefore weighs by how much A and B vary.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.redundancy import block_means, length

DELAYS = 3  # sums of products: the delays of A and of B, and e squared
LEAST_VARIATION = 1e-3  # of A and B, in squared steps a step: keeps its logarithm finite
LEAST_STEPS = 1e-2


def delay_products(parts: Float[Tensor, "s1 b 4 h w"], pooled: int) -> Float[Tensor, "b 3 h/{pooled} w/{pooled}"]:
    """`DELAYS` of the events of s parts of a window and the part before them, means over blocks of `pooled` pixels."""
    e0, e45, e90, e135 = parts.unbind(2)
    a, b, e = e0 - e90, e45 - e135, (e0 + e45 + e90 + e135) / 4
    delayed = [(x[:-1] * e[1:] - x[1:] * e[:-1]).sum(0) for x in (a, b)]
    return block_means(torch.stack([*delayed, e[1:].square().sum(0)], dim=1), pooled)


class Delays(nn.Module):
    """(s1, s2) as the delays tell them, and how far that is to be believed, by itself: a logit.

    For each decay and scale a gain is learnt, and how the logit falls with the logarithm of the variance of A and B.
    """

    def __init__(self, memories: int, decays: int, scales: int):
        super().__init__()
        slope = torch.zeros(memories, decays, scales)
        slope[memories // 2] = 2.0
        self.slope = nn.Parameter(slope)
        self.offset = nn.Parameter(torch.full((decays, scales), 2 * math.log(0.2)))
        self.log_gain = nn.Parameter(torch.full((decays, scales), 1.1))
        self.log_ridge = nn.Parameter(torch.full((decays, scales), -4.0))

    def forward(
        self, products: Float[Tensor, "n d k 3 h w"], moments: Float[Tensor, "n m d k 6 h w"]
    ) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n c h w"], Float[Tensor, "n c h w"]]:
        """s1, s2 with hypot(s1, s2) < 1, and the logit, from summed products and `SecondMoments`; c = d * k."""
        of_a, of_b, energy = products.unbind(3)
        gain = self.log_gain.exp()[..., None, None] / (energy + self.log_ridge.exp()[..., None, None])
        s1, s2 = gain * of_a, gain * of_b
        inside = 1 / (1 + length(s1, s2))
        aa, _, bb, _, _, steps = moments.unbind(4)
        variation = (F.relu(aa) + F.relu(bb) + LEAST_VARIATION) / (steps + LEAST_STEPS)
        logit = self.offset[..., None, None] - (self.slope[..., None, None] * variation.log()).sum(1)
        return tuple(field.flatten(1, 2) for field in (s1 * inside, s2 * inside, logit))  # type: ignore[return-value]
