"""Level of (s1, s2) from shot noise, of which dim pixels fire more.

A pixel fires ON and OFF events from shot noise even while its light is constant, and more of them in dim light
(docs/physics.md). Behind the polarizer that transmits least, pixels fire most. The rates of two crossed channels
therefore tell which of them is darker, even where polarization is uniform and the redundancy of four channels says
nothing.

Shot noise is counted where little else fires: a pixel's events are isolated if its channel is silent at the eight
pixels around it in the same window, and at most one of all nine fired in the window before. Isolated events also come
from edges of low contrast, so a sensor with few of them says nothing. To save time, only a quarter of the pixels is
counted.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.polarnet.redundancy import length

COUNTS = 2  # isolated events and quiet pixels, of each channel
KEPT = 0.98  # decay of both per window
FEW = 3.0  # events of the usual rate that are added to those of each channel
APART = 2  # pixels from one counted pixel to the next along each axis
GAIN = 0.4  # change of s1 per difference of the rates' logarithms; this and the next: from training photographs
USUAL_RATE = 0.09  # isolated events per quiet pixel and window with which shot noise moves the level by half of this
SHARPNESS = 6.0  # exponent of the rate over USUAL_RATE


class Counts(NamedTuple):
    """Isolated events and quiet pixels among the counted ones, summed over time, after each of t windows."""

    isolated: Float[Tensor, "t b 4"]
    """Several events of a pixel in one window count once, so that a hot pixel counts little."""
    quiet: Float[Tensor, "t b 4"]


@torch.no_grad()
def isolated_events(count: Float[Tensor, "t b 4 h w"], state: list[Tensor]) -> tuple[Counts, list[Tensor]]:
    """Count isolated events and quiet pixels over t windows, from the numbers of events at the sensor's pixels.

    `state` is empty at the start. Otherwise it holds the last counts, and how many of the nine pixels around each
    counted pixel fired in the window before.
    """
    nothing = torch.zeros_like(count[0, ..., ::APART, ::APART])
    counts, before = state or [count.new_zeros(COUNTS, *count.shape[1:3]), nothing]
    after = []
    for window in count:
        fired = F.pad(F.relu(torch.sign(window)), (1, 1, 1, 1))
        rows = fired[..., :-2:APART, :] + fired[..., 1:-1:APART, :] + fired[..., 2::APART, :]
        around = rows[..., :-2:APART] + rows[..., 1:-1:APART] + rows[..., 2::APART]
        centre = fired[..., 1:-1:APART, 1:-1:APART]
        quiet = ((around == centre) & (before <= 1)).to(count.dtype)
        counts = KEPT * counts + torch.stack([(quiet * centre).sum((-1, -2)), quiet.sum((-1, -2))])
        before = around
        after.append(counts)
    return Counts(*torch.stack(after, dim=1)), [counts, before]


class ShotNoise(nn.Module):
    """Moves the level of (s1, s2), by what the rates of isolated events ask for. Two numbers are trained.

    s1 moves by gain * share * log(r90 / r0), and s2 likewise by the rates r135 and r45. The share is r^k / (r^k + u^k),
    with r the mean rate of the four channels, u the trained usual rate and k the `SHARPNESS`.
    """

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(GAIN))
        self.log_rate = nn.Parameter(torch.tensor(USUAL_RATE).log())

    def forward(self, counts: Counts) -> Float[Tensor, "n 2 1 1"]:
        """Return the changes of s1 and s2 for n = t * b images."""
        isolated, quiet = (field.flatten(0, 1) for field in counts)
        tiny = torch.finfo(quiet.dtype).tiny
        rate = isolated.sum(1, keepdim=True) / (quiet.sum(1, keepdim=True) + tiny)
        share = torch.sigmoid(SHARPNESS * (torch.log(rate + tiny) - self.log_rate))
        logs = torch.log((isolated + FEW) / (quiet * rate + FEW))
        return (self.gain * share * (logs[:, 2:] - logs[:, :2]))[..., None, None]


def moved_by_noise(stokes: Float[Tensor, "n 2 h w"], moves: Float[Tensor, "n 2 1 1"]) -> Float[Tensor, "n 2 h w"]:
    """Add the moves to (s1, s2), and shorten vectors that become longer than 1."""
    moved = stokes + moves
    return moved / length(*moved.unbind(1))[:, None].clamp(min=1)
