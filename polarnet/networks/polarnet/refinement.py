"""Steps from a coarse map of (s1, s2) to a fine one: the level from shot noise, event sums, and the panorama.

Shot noise fires ON and OFF events even under constant light, and more of them in dim light (docs/physics.md). The rates
of two crossed channels therefore tell which of them is darker, even where polarization is uniform and the redundancy of
four channels says nothing. Shot noise is counted where little else fires: a pixel's events are isolated if its channel
is silent at the eight pixels around it in the same window, and at most one of all nine fired in the window before.
Isolated events also come from edges of low contrast, so a sensor with few of them says nothing.

e0 - e90 counts the change of 2 atanh(s1) at a pixel, and e45 - e135 that of 2 atanh(s2). The network learns the gains
of such sums and the share of the panorama.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base.blocks import enlarged
from polarnet.networks.polarnet import kernels
from polarnet.networks.polarnet.redundancy import block_means, box_means, faded, length

KEPT = 0.98  # decay of the counts per window
FEW = 3.0  # events of the usual rate that are added to those of each channel
APART = 2  # pixels from one counted pixel to the next along each axis, to save time
GAIN = 0.4  # change of s1 per difference of the rates' logarithms; this and the next: from training photographs
USUAL_RATE = 0.09  # isolated events per quiet pixel and window with which shot noise moves the level by half of this
SHARPNESS = 6.0  # exponent of the rate over USUAL_RATE
WIDE = (3, 9)  # widths in pixels of the neighbourhoods that contribute fine structure, besides the single pixel
MAX_DOLP = 0.98  # largest DoLP passed to atanh, to keep it finite


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
    counts, before = state or [count.new_zeros(len(Counts._fields), *count.shape[1:3]), nothing]
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
    """Changes of the level of (s1, s2) for rates of isolated events. Two numbers are trained.

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


def differences(events: Float[Tensor, "*b 4 h w"]) -> Float[Tensor, "*b 2 h w"]:
    """Return e0 - e90 and e45 - e135."""
    return events[..., :2, :, :] - events[..., 2:, :, :]


def wide_differences(
    polarity: Float[Tensor, "t b 4 h w"], before: Sequence[Tensor | None], keep: Float[Tensor, "m 1 1 1"]
) -> list[Float[Tensor, "t b m 2 h w"]]:
    """Update the sums `before` of e0 - e90 and e45 - e135, for each memory, averaged over each width of `WIDE`.

    Averaging and summing commute, so each window is averaged once instead of once per memory.
    """
    now = differences(polarity)
    near = (box_means(now.flatten(0, 1), width).contiguous().unflatten(0, now.shape[:2]) for width in WIDE)
    return [faded(means.unsqueeze(2), keep, state) for means, state in zip(near, before, strict=True)]


def event_moves(
    sums: Sequence[Float[Tensor, "t b m 2 h w"]], gains: Float[Tensor, "n g h w"]
) -> Float[Tensor, "n 2 h w"]:
    """Return the sums of gains times event sums."""
    moves = gains.new_zeros(())
    for gain, near in zip(gains.contiguous().chunk(len(sums), dim=1), sums, strict=True):
        moves = torch.addcmul(moves, gain.unflatten(1, (-1, 1)), near.flatten(0, 1))
    return moves.sum(1)


def compiled_event_moves(
    sums: Sequence[Float[Tensor, "t b m 2 h w"]], y: Float[Tensor, "n c h/2 w/2"], layer: nn.Conv2d
) -> Float[Tensor, "n 2 h w"]:
    """Return `event_moves` for the gains that a 1x1 convolution computes for 2x2 pixels at once, with the kernel."""
    assert layer.bias is not None
    moves = torch.zeros(len(y), *sums[0].shape[-3:])
    for n, pixels in enumerate(y.permute(0, 2, 3, 1)):
        gains = torch.addmm(layer.bias[:, None], layer.weight.flatten(1), pixels.flatten(0, 1).T).float()
        for gain, near in zip(gains.unflatten(1, pixels.shape[:2]).chunk(len(sums)), sums, strict=True):
            kernels.add_moves(near.flatten(0, 1)[n], gain, moves[n])
    return moves


def averaged(
    stokes: Float[Tensor, "n 2 h w"],
    dolp: Float[Tensor, "n 1 h w"],
    panorama: Float[Tensor, "n 2 h/2 w/2"],
    share: Float[Tensor, "n 1 #h #w"],
    around: int,
) -> tuple[Float[Tensor, "n 2 h w"], Float[Tensor, "n 1 h w"]]:
    """Interpolate (s1, s2) and DoLP towards a panorama, with weight `share`.

    `panorama` holds atanh(s1) and atanh(s2) up to additive constants. The constants are chosen so that its mean over
    `around` pixels at quarter resolution matches that of (s1, s2).
    """
    short = length(*stokes.unbind(1))[:, None]
    own = torch.atanh(stokes / short * torch.maximum(short, dolp).clamp(max=MAX_DOLP))
    constants = box_means(block_means(own, 4) - block_means(panorama, 2), around)
    aligned = torch.tanh(enlarged(panorama + enlarged(constants, 2), 2))
    return torch.lerp(stokes, aligned, share), torch.lerp(dolp, length(*aligned.unbind(1))[:, None], share)
