"""Fine structure of (s1, s2): a coarse map on the true scale is moved by sums of events, then joined to the panorama.

e0 - e90 counts the change of 2 atanh(s1) at a pixel, and e45 - e135 that of 2 atanh(s2). The network calls these
functions with gains and shares that it has learned.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.networks.base.blocks import enlarged
from polarnet.networks.polarnet.redundancy import block_means, box_means, faded, length

WIDE = (3, 9)  # widths in pixels of the neighbourhoods that contribute fine structure, besides the single pixel
MAX_DOLP = 0.98  # largest DoLP passed to atanh, to keep it finite


def wide_differences(
    polarity: Float[Tensor, "t b 4 h w"], before: Sequence[Tensor | None], keep: Float[Tensor, "m 1 1 1"]
) -> list[Float[Tensor, "t b m 2 h w"]]:
    """Update the sums `before` of e0 - e90 and e45 - e135, for each memory, averaged over each width of `WIDE`.

    Averaging and summing commute, so each window is averaged once instead of once per memory.
    """
    now = differences(polarity)
    near = (box_means(now.flatten(0, 1), width).contiguous().unflatten(0, now.shape[:2]) for width in WIDE)
    return [faded(means.unsqueeze(2), keep, state) for means, state in zip(near, before, strict=True)]


def differences(events: Float[Tensor, "*b 4 h w"]) -> Float[Tensor, "*b 2 h w"]:
    """Return e0 - e90 and e45 - e135."""
    return events[..., :2, :, :] - events[..., 2:, :, :]


def moved_by_events(
    stokes: Float[Tensor, "n 2 h w"], sums: Sequence[Float[Tensor, "t b m 2 h w"]], gains: Float[Tensor, "n g h w"]
) -> Float[Tensor, "n 2 h w"]:
    """Update (s1, s2) by adding gains times event sums to atanh(s1) and atanh(s2)."""
    moves = stokes.new_zeros(())
    for gain, near in zip(gains.contiguous().chunk(len(sums), dim=1), sums, strict=True):
        moves = torch.addcmul(moves, gain.unflatten(1, (-1, 1)), near.flatten(0, 1))
    return torch.tanh(torch.atanh(MAX_DOLP * stokes) + moves.sum(1))


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
    panorama = panorama + enlarged(constants, 2)
    aligned = torch.tanh(enlarged(panorama, 2))
    return torch.lerp(stokes, aligned, share), torch.lerp(dolp, length(*aligned.unbind(1))[:, None], share)
