"""Relative sensitivities of a sensor's pixels, estimated from their numbers of events.

Contrast thresholds differ between pixels, and a pixel's ON and OFF thresholds differ independently. A pixel with half
the threshold fires about twice as often. In a moving scene, neighbouring pixels see nearly the same changes of light.
The number of a pixel's events relative to its neighbours' therefore measures its sensitivity.

Counts are noisy. `Equaliser` also estimates how much sensitivities differ over the sensor, and moves each pixel's count
towards its neighbours' by the corresponding amount (empirical Bayes). A sensor without mismatch keeps its events.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.blocks import enlarged
from polarnet.networks.polarnet.redundancy import block_means, box_means

BLOCK = 4  # side in pixels of the blocks whose means form a neighbourhood
BLOCKS = 3  # width of a neighbourhood in blocks
MISMATCH = (0.01, 1.5)  # limits of the estimated variance of relative sensitivities
WEIGHTS = (0.02, 3.0)  # limits of an event's weight
OUTLIER = 2.0  # limit of a pixel's relative deviation, so that a hot pixel cannot dominate the mismatch
SPARSE = 2  # the mismatch is estimated from every SPARSE-th pixel along each axis
MIN_POWER = 1e-2  # lower limit of the mean squared count


class Equalised(NamedTuple):
    """Events of t windows, weighted by the estimated thresholds of their pixels."""

    polarity: Float[Tensor, "t b 4 h w"]
    """Weighted sum of polarities."""
    events: Float[Tensor, "t b 4 h w"]
    """Weighted number of events."""
    total: Float[Tensor, "t b"]
    """Weighted number of events per pixel and polarity since the start."""
    mismatch: Float[Tensor, "t b"]
    """Estimated variance of relative sensitivities, as a mean over channels and polarities."""


class Equaliser(nn.Module):
    """Weights events so that all pixels, and both polarities, appear to have the same threshold.

    Three numbers are trained: the variance of a pixel's count relative to its mean in a sensor without mismatch, the
    strength of the prior, and the number of events per pixel by which ON and OFF events differ by chance.
    """

    def __init__(self):
        super().__init__()
        self.log_noise = nn.Parameter(torch.tensor(-0.3))
        self.log_pull = nn.Parameter(torch.tensor(0.7))
        self.log_surplus = nn.Parameter(torch.tensor(1.0))

    def forward(
        self, polarity: Float[Tensor, "t b 4 h w"], count: Float[Tensor, "t b 4 h w"], state: list[Tensor]
    ) -> tuple[Equalised, list[Tensor]]:
        """Weight the events of t windows, each with what is known at its end.

        `state` is empty at the start. Otherwise it holds the numbers of ON and OFF events so far, and the change of
        their weights from 1.
        """
        events = F.relu(torch.cat([count + polarity, count - polarity], dim=2)) / 2
        totals, change = state or [torch.zeros_like(events[0])] * 2
        noise, pull, surplus = self.log_noise.exp(), self.log_pull.exp(), self.log_surplus.exp()
        weighted, sums, mismatches = [], [], []
        for now in events:
            totals = totals + now
            mean = _near(torch.addcmul(totals, totals, change))
            some, some_mean = totals[..., ::SPARSE, ::SPARSE], mean[..., ::SPARSE, ::SPARSE]
            deviation = torch.minimum((some - some_mean).abs(), OUTLIER * (some_mean + 1))
            power = some_mean.square().mean((-1, -2), keepdim=True).clamp(min=MIN_POWER)
            excess = (deviation.square() - noise * some_mean).mean((-1, -2), keepdim=True)
            mismatch = (excess / power).clamp(*MISMATCH)
            prior = pull * noise / mismatch
            weight = ((mean + prior) / (totals + prior)).clamp(*WEIGHTS)
            change = weight.detach() - 1
            mean_counts = mean.mean((-1, -2), keepdim=True)
            on, off = (half.mean(1, keepdim=True) + surplus for half in mean_counts.split(4, dim=1))
            balance = (off / on).sqrt()  # over a while, the light rises as much as it falls
            both = torch.cat([balance, 1 / balance], dim=1).repeat_interleave(4, dim=1)
            weighted.append(now * (weight * both))
            sums.append(mean_counts.mean((1, 2, 3)))
            mismatches.append(mismatch.detach().mean((1, 2, 3)))
        on, off = torch.stack(weighted).split(4, dim=2)
        return Equalised(on - off, on + off, torch.stack(sums), torch.stack(mismatches)), [totals, change]


def _near(x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """Return means over the neighbourhood of each pixel."""
    return enlarged(box_means(block_means(x, BLOCK), BLOCKS), BLOCK)
