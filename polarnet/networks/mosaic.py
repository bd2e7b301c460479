"""A picture of log intensity behind each polarizer, gathered along the motion of the scene, without training.

A pixel's own sum of events tells how much its log intensity has changed since the start: without the start itself, and
with errors that grow event by event, because thresholds differ between pixels. A scene that moves past the sensor
shows each of its points to many pixels. While it moves by a displacement d, what is at p comes from p + d, so that the
events of a window are differences of one picture,

    e(p) = L(p + d) - L(p),    in the Fourier domain    (exp(i f d) - 1) L(f).

Each window is such a measurement of L, blind to what varies only across its own d; windows that move otherwise see
that. `follow` solves them together by recursive least squares, which is a division for each frequency: of what the
picture so far does not explain of a window's events, exp(i f d) - 1 says where in L it belongs, and the sum of
|exp(i f d) - 1|^2 over past windows how much of it to believe. Mosaicing with event cameras (Kim et al., BMVC 2014)
does this pixel by pixel.

The motion is one displacement a window, where the events of two windows in a row correlate best (`displacements`).
Lengths are pixels of the images given; log intensities count in steps, the contrast threshold of an event.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

MOST_EVENTS = 6.0  # of a pixel in a window that count in the search: a pixel that fires without end shall not decide
LEAST_CORRELATION = 0.1  # of two windows that are said to show one motion
LEAST_OVERLAP = 0.1  # of two windows, for their correlation to count in full
ROUND = 16  # sizes are made multiples of it, for which Fourier transforms are fast


class Memory(NamedTuple):
    """How `follow` weighs what it knows."""

    keep: float
    """What the certainty of before counts one window later."""
    ridge: float
    """Certainty, in windows, that frequencies which were never measured are 0."""
    fade: float
    """What is left one window later of what has moved out of sight."""


class Motion(NamedTuple):
    """What moved from one window to the next."""

    displacement: Float[Tensor, "*n 2"]
    """(x, y): what is at p now was at p + displacement one window before."""
    found: Bool[Tensor, "*n"]
    """Whether both windows show it."""


class Picture(NamedTuple):
    """What `follow` carries along; all zeros when nothing has been seen.

    The image is larger than the sensor's and its opposite sides meet: what moves out of sight passes the margin, where
    it fades, before it comes in again from the other side.
    """

    level: Float[Tensor, "b 4 H W"]
    """Log intensity behind the polarizers, but for a constant; the sensor sees the first rows and columns."""
    certainty: Float[Tensor, "b 1 H F"]
    """Of each spatial frequency: the sum of |exp(i f d) - 1|^2."""


def nothing_seen(like: Float[Tensor, "b c h w"], margin: int) -> Picture:
    """The picture at the start, for images of this size and at least so many pixels beyond them."""
    b, height, width = like.shape[0], _round(like.shape[-2] + margin), _round(like.shape[-1] + margin)
    return Picture(like.new_zeros(b, 4, height, width), like.new_zeros(b, 1, height, width // 2 + 1))


def _round(size: int) -> int:
    return -(-size // ROUND) * ROUND


def displacements(images: Float[Tensor, "t1 b h w"], reach: int) -> Motion:
    """Where the images of two windows in a row correlate best, within `reach` pixels along each axis: [t, b].

    Finer than a pixel by the parabola through the best place and its neighbours.
    """
    height, width = images.shape[-2:]
    images = images.clamp(-MOST_EVENTS, MOST_EVENTS)
    # nothing wraps around, and all of the places looked at are there
    size = (_round(max(height, reach + 2) + reach + 1), _round(max(width, reach + 2) + reach + 1))
    spectrum = torch.fft.rfft2(images, s=size)
    correlation = torch.fft.irfft2(spectrum[:-1] * spectrum[1:].conj(), s=size)
    correlation = torch.roll(correlation, (reach + 1, reach + 1), (-2, -1))
    side = 2 * reach + 1
    steps = torch.arange(-reach - 1, reach + 2, device=images.device).abs()
    overlap = (1 - steps / height).clamp(min=LEAST_OVERLAP)[:, None] * (1 - steps / width).clamp(min=LEAST_OVERLAP)
    correlation = correlation[..., : side + 2, : side + 2] / overlap
    best = correlation[..., 1:-1, 1:-1].flatten(-2).argmax(-1)
    at = (best // side + 1) * (side + 2) + best % side + 1
    around = correlation.flatten(-2)
    middle, left, right, above, below = (
        around.gather(-1, (at + shift)[..., None])[..., 0] for shift in (0, -1, 1, -side - 2, side + 2)
    )
    x = (best % side - reach) + _vertex(left, middle, right)
    y = (best // side - reach) + _vertex(above, middle, below)
    energy = images.square().sum((-2, -1)).sqrt()
    return Motion(torch.stack([x, y], dim=-1), middle > LEAST_CORRELATION * (energy[:-1] * energy[1:]).clamp(min=1e-6))


def _vertex(left: Float[Tensor, "*n"], middle: Float[Tensor, "*n"], right: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Where between -1/2 and 1/2 the parabola through three values at -1, 0 and 1 is highest."""
    bend = (2 * middle - left - right).clamp(min=1e-12)
    return ((right - left) / (2 * bend)).clamp(-0.5, 0.5)


def follow(changes: Float[Tensor, "b 4 h w"], motion: Motion, picture: Picture, memory: Memory) -> Picture:
    """The picture one window later. Where no motion was found it stays as it is, and is less certain.

    With m = exp(i f d), L moves to m L, r is what the events differ from m L - L in sight, c <- keep c + |m - 1|^2,
    and m L gains (1 - m) r / (c + ridge).
    """
    height, width = changes.shape[-2:]
    rows, columns = picture.level.shape[-2:]
    size = (rows, columns)
    move = _move(motion, size)
    moved = torch.fft.irfft2(torch.fft.rfft2(picture.level) * move, s=size)
    unexplained = changes - (moved - picture.level)[..., :height, :width]
    beyond = (0, columns - width, 0, rows - height)
    certainty = memory.keep * picture.certainty + (move - 1).abs().square()
    spectrum = torch.fft.rfft2(F.pad(unexplained, beyond)) * ((1 - move) / (certainty + memory.ridge))
    level = moved + torch.fft.irfft2(spectrum, s=size)
    return Picture(level * F.pad(level.new_ones(height, width), beyond, value=memory.fade), certainty)


def _move(motion: Motion, size: tuple[int, int]) -> Tensor:
    """exp(i f d) for every frequency f, complex [b, 1, H, F]; 1 where no motion was found."""
    d = torch.where(motion.found[:, None], motion.displacement, 0.0)[:, :, None, None, None]
    rows, columns = (torch.arange(number, device=d.device) for number in (size[0], size[1] // 2 + 1))
    down = 2 * math.pi / size[0] * torch.where(2 * rows < size[0], rows, rows - size[0])[:, None]
    across = 2 * math.pi / size[1] * columns
    angle = across * d[:, 0] + down * d[:, 1]
    return torch.complex(angle.cos(), angle.sin())
