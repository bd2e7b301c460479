"""Relative sensitivities of a sensor's pixels, estimated from their numbers of events.

Contrast thresholds differ between pixels, and ON and OFF thresholds of a pixel differ independently. A pixel with half
the threshold fires twice as often. The scene moves over the sensor, so neighbouring pixels see nearly the same changes
of light, and a pixel's number of events compared with that of its neighbours tells its sensitivity.

Both are uncertain while there are few events. `Equaliser` therefore estimates how much the sensitivities of the whole
sensor differ, and draws each pixel's towards that of its neighbours accordingly (empirical Bayes). A pixel whose
counts agree with its neighbours' within their noise keeps its events.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.redundancy import block_means, box_means

POOLED = 4  # pixels along each axis that are averaged before neighbourhoods are
NEIGHBOURHOOD = 3  # blocks of POOLED pixels along each axis
MISMATCH = (0.01, 1.5)  # limits of the variance of relative sensitivities
GAINS = (0.02, 3.0)  # limits of an event's weight
OUTLIER = 2.0  # larger relative deviations from the neighbours count as this in the mismatch
MIN_COUNT = 1e-2  # events per pixel, lower limit in denominators


class Equalised(NamedTuple):
    """Events of t windows, each weighted by its pixel's estimated threshold relative to that of its neighbours."""

    polarity: Float[Tensor, "t b 4 h w"]
    """Weighted sum of polarities."""
    count: Float[Tensor, "t b 4 h w"]
    """Weighted number of events."""
    total: Float[Tensor, "t b"]
    """Weighted number of events per pixel since the start."""
    mismatch: Float[Tensor, "t b"]
    """Estimated variance of relative sensitivities, as a mean over channels and polarities."""


class Equaliser(nn.Module):
    """Estimates relative sensitivities window by window; three numbers are trained."""

    def __init__(self):
        super().__init__()
        self.log_noise = nn.Parameter(torch.tensor(-0.3))  # variance of a count over its mean, from the scene alone
        self.log_pull = nn.Parameter(torch.tensor(0.7))  # towards the neighbours, relative to the theoretical pull

        self.log_surplus = nn.Parameter(torch.tensor(1.0))  # events per pixel that ON and OFF may differ by

    def forward(
        self,
        polarity: Float[Tensor, "t b 4 h w"],
        count: Float[Tensor, "t b 4 h w"],
        state: list[Tensor],
    ) -> tuple[Equalised, list[Tensor]]:
        """Weight the events of t windows; `state` holds the numbers of events so far and the latest weights."""
        events = torch.cat([count + polarity, count - polarity], dim=2) / 2
        totals, gains = state or [torch.zeros_like(events[0]), torch.ones_like(events[0])]
        noise, pull, surplus = self.log_noise.exp(), self.log_pull.exp(), self.log_surplus.exp()
        weighted, sums, mismatches = [], [], []
        for now in events:
            totals = totals + now
            with torch.no_grad():
                mean = _near(totals * gains)
                deviation = torch.minimum((totals - mean).abs(), OUTLIER * (mean + 1))
                power = mean.square().mean((-1, -2), keepdim=True).clamp(min=MIN_COUNT)
            excess = (deviation.square() - noise * mean).mean((-1, -2), keepdim=True)
            mismatch = (excess / power).clamp(*MISMATCH)
            prior = pull * noise / mismatch
            free = ((mean + prior) / (totals + prior)).clamp(*GAINS)
            on, off = (half.mean((1, 2, 3), keepdim=True) + surplus for half in totals.split(4, dim=1))
            balance = (off / on).sqrt()
            weighted.append(now * free * torch.cat([balance, 1 / balance], dim=1).repeat_interleave(4, dim=1))
            mismatches.append(mismatch.mean((1, 2, 3)))
            gains = free.detach()
            sums.append((totals * gains).mean((1, 2, 3)))
        on, off = torch.stack(weighted).split(4, dim=2)
        equalised = Equalised(on - off, on + off, torch.stack(sums), torch.stack(mismatches).detach())
        return equalised, [totals, gains]


def _near(x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    """Return means over the neighbourhood of each pixel."""
    return F.interpolate(box_means(block_means(x, POOLED), NEIGHBOURHOOD), scale_factor=POOLED, mode="bilinear")


SCALE_FEATURES = 6
MAX_LOG_SCALE = 1.5  # limit of the logarithm of the estimated scale


class Scale(nn.Module):
    """Estimates the contrast threshold from how events and panorama look, relative to `panorama_step`.

    Multiplying all log intensities by one number multiplies events and panorama alike, so the events alone cannot tell
    the threshold from the contrast of the scene. But contrasts of scenes vary less than thresholds of sensors, and
    mismatch of pixels grows as the threshold falls.
    """

    def __init__(self, hidden: int = 16):
        super().__init__()
        self.hidden = nn.Linear(SCALE_FEATURES, hidden)
        self.out = nn.Linear(hidden, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Float[Tensor, "n k"]) -> Float[Tensor, "n 1 1 1"]:
        """Return the factor by which an event changes log intensity, relative to `panorama_step`."""
        with torch.autocast(features.device.type, enabled=False):
            log_scale = self.out(torch.tanh(self.hidden(features.float())))
            return log_scale.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).exp()[..., None, None]


def scale_features(
    images: Float[Tensor, "n 4 h w"], total: Float[Tensor, " n"], mismatch: Float[Tensor, " n"]
) -> Float[Tensor, "n k"]:
    """Compute the features of `Scale` from a panorama in steps, the events per pixel so far, and the mismatch.

    The features are logarithms of the standard deviation of the mean image, of that of the two contrasts, of the mean
    slopes of both, and of the number of events; and the standard deviation of sensitivities.
    """
    mean, contrast = images[:, :1], images[:, 1:3]
    spreads = [part.flatten(2).var(-1).mean(1).sqrt() for part in (mean, contrast)]
    slopes = [
        (
            (part[..., 1:] - part[..., :-1]).abs().mean((1, 2, 3))
            + (part[..., 1:, :] - part[..., :-1, :]).abs().mean((1, 2, 3))
        )
        / 2
        for part in (mean, contrast)
    ]
    return torch.stack([*((one + 0.01).log() for one in (*spreads, *slopes, total)), mismatch.sqrt()], dim=1)
