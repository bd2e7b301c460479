"""Contrast thresholds of a sensor, estimated from its events: of pixels relative to each other, and on the whole.

Neighbouring pixels of a moving scene see nearly the same changes of light, and a pixel with half the threshold fires
about twice as often. The number of a pixel's events relative to its neighbours' therefore measures its sensitivity.
Counts are noisy, so `Equaliser` also estimates how much sensitivities differ over the sensor, and moves each pixel's
count towards its neighbours' by the corresponding amount (empirical Bayes).

Events alone cannot tell the sensor's threshold from the contrast of the scene. But contrasts differ less between scenes
than thresholds between sensors, and a lower threshold usually comes with a larger relative mismatch. `Scale`, a small
perceptron, weighs these clues; the loss of DoLP trains it.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.blocks import enlarged
from polarnet.networks.polarnet import kernels
from polarnet.networks.polarnet.redundancy import block_means, box_means

BLOCK = 4  # side in pixels of the blocks whose means form a neighbourhood
BLOCKS = 3  # width of a neighbourhood in blocks
MISMATCH = (0.01, 1.5)  # limits of the estimated variance of relative sensitivities
WEIGHTS = (0.02, 3.0)  # limits of an event's weight
OUTLIER = 2.0  # limit of a pixel's relative deviation, so that a hot pixel cannot dominate the mismatch
SPARSE = 2  # the mismatch is estimated from every SPARSE-th pixel along each axis
MIN_POWER = 1e-2  # lower limit of the mean squared count
FEATURES = 6  # of Scale
HIDDEN = 16
MAX_LOG_SCALE = 1.5  # limit of the scale's logarithm
MIN_FEATURE = 0.01  # added to features, in steps, before their logarithm


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
        if polarity.shape[1] == 1 and kernels.compiled_path(polarity):
            return self._compiled(polarity, count, state)
        events = F.relu(torch.cat([count + polarity, count - polarity], dim=2)) / 2
        totals, change = state or [torch.zeros_like(events[0])] * 2
        noise, pull, surplus = self.log_noise.exp(), self.log_pull.exp(), self.log_surplus.exp()
        weighted, sums, mismatches = [], [], []
        for now in events:
            totals = totals + now
            mean = enlarged(box_means(block_means(torch.addcmul(totals, totals, change), BLOCK), BLOCKS), BLOCK)
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

    def _compiled(
        self, polarity: Float[Tensor, "t 1 4 h w"], count: Float[Tensor, "t 1 4 h w"], state: list[Tensor]
    ) -> tuple[Equalised, list[Tensor]]:
        """Same as `forward`, with the kernels."""
        noise, pull, surplus = (p.exp().numpy() for p in (self.log_noise, self.log_pull, self.log_surplus))
        polarity, count = polarity.contiguous(), count.contiguous()
        totals, change = state or [polarity.new_zeros(1, 8, *polarity.shape[-2:]) for _ in range(2)]
        height, width = (size // BLOCK for size in polarity.shape[-2:])
        limits = np.array(WEIGHTS, np.float32)
        polarities, events = torch.empty_like(polarity), torch.empty_like(count)
        strips = np.empty((height, 8, 2), np.float32)
        sums, mismatches = [], []
        for k in range(len(polarity)):
            window = (polarity[k, 0], count[k, 0])
            blocks, after = polarity.new_empty(1, 8, height, width), torch.empty_like(totals)
            kernels.add_events(*window, totals[0], change[0], after[0], blocks[0])
            near = box_means(blocks, BLOCKS)[0].numpy()
            totals, change = after, torch.empty_like(totals)
            kernels.deviations(totals[0], near, noise[()], np.float32(OUTLIER), strips)
            power, excess = (strips.sum(0, dtype=np.float64) / (4 * height * width)).T
            mismatch = (excess / power.clip(MIN_POWER)).clip(*MISMATCH)
            mean_counts = near.mean((1, 2), dtype=np.float64)  # interpolation keeps the mean
            on, off = mean_counts[:4].mean() + surplus, mean_counts[4:].mean() + surplus
            balance = np.sqrt([off / on, on / off]).repeat(4).astype(np.float32)
            prior = (pull * noise / mismatch).astype(np.float32)
            images = (change[0], polarities[k, 0], events[k, 0])
            kernels.weigh(*window, totals[0], near, prior, balance, limits, *images)
            sums.append(mean_counts.mean())
            mismatches.append(mismatch.mean())
        summary = polarity.new_tensor([sums, mismatches])[..., None]
        return Equalised(polarities, events, *summary), [totals, change]


class Scale(nn.Module):
    """The change of log intensity per event, relative to `panorama_step`."""

    given: float | None = None
    """Known value, which replaces the estimate; None: unknown."""

    def __init__(self):
        super().__init__()
        self.hidden = nn.Linear(FEATURES, HIDDEN)
        self.out = nn.Linear(HIDDEN, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Float[Tensor, "n k"]) -> Float[Tensor, "n 1 1 1"]:
        """Return the scale of each of n images, for features from `scale_features`."""
        if self.given is not None:
            return features.new_full((len(features), 1, 1, 1), self.given)
        with torch.autocast(features.device.type, enabled=False):
            log_scale = self.out(torch.tanh(self.hidden(features)))
            return log_scale.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).exp()[..., None, None]


def scale_features(
    panorama: Float[Tensor, "n 4 h w"], total: Float[Tensor, " n"], mismatch: Float[Tensor, " n"]
) -> Float[Tensor, "n k"]:
    """Compute the features of `Scale` from the panorama in steps, the events per pixel so far, and the mismatch.

    Logarithms of the standard deviation of the mean of the four channels and that of the two contrasts, of the mean
    absolute slopes of both, and of the number of events; then the standard deviation of relative sensitivities.
    """
    parts = (panorama[:, :1], panorama[:, 1:3])
    spreads = [part.flatten(2).var(-1).mean(1).sqrt() for part in parts]
    steps = [[part.diff(dim=axis).abs().mean((1, 2, 3)) for axis in (-1, -2)] for part in parts]
    slopes = [(across + down) / 2 for across, down in steps]
    logs = [torch.log(one + MIN_FEATURE) for one in (*spreads, *slopes, total)]
    return torch.stack([*logs, mismatch.sqrt()], dim=1)
