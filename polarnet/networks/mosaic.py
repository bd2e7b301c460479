"""Pictures of what the polarizers see and differ by, gathered along the motion of the scene, without training.

A pixel's own sum of events tells how much its log intensity has changed since the start: without the start itself, and
with errors that grow event by event, because thresholds differ between pixels. A scene that moves past the sensor
shows each of its points to many pixels, so that there are two images of the same thing: `own`, what each pixel has
summed up, and `level`, which moves along with the scene. What is at p after a displacement d was at p + d, in the
Fourier domain a factor exp(i f d). An error of `own` stays at its pixel while that of `level` moves along, and so one
image tells the errors of the other, wherever the scene varies along its motion.

`follow` is the Kalman filter of the two, one for each spatial frequency: what is expected of a picture before anything
was seen has a power that falls with the square of the frequency, and at the start both images are 0, with the same
error. Infrared sensors are rid of their fixed patterns by such registration (Hardie et al., Applied Optics 2000);
mosaicing with event cameras (Kim et al., BMVC 2014) filters pixel by pixel.

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
    """What `follow` expects of pictures and pixels; variances are those of white noise, in squared steps."""

    prior: float
    """Variance of a picture at a frequency of 1 radian a pixel; it falls with the square of the frequency."""
    noise: float
    """Variance of a pixel's sum of events by itself, anew in each window, such as that of whole steps."""
    drift: float
    """Variance by which a pixel's sum of events goes astray in a window."""
    renewal: float
    """How much of the part of the image that a displacement exchanges counts as never seen, for all of the image."""
    fade: float
    """What is left one window later of what has moved out of sight, and of all certainty where no motion was found."""


class Motion(NamedTuple):
    """What moved from one window to the next."""

    displacement: Float[Tensor, "*n 2"]
    """(x, y): what is at p now was at p + displacement one window before."""
    found: Bool[Tensor, "*n"]
    """Whether both windows show it."""


class Picture(NamedTuple):
    """What `follow` carries along; all zeros when nothing has been seen.

    `level` is larger than the sensor's image and its opposite sides meet: what moves out of sight passes the margin,
    where it fades, before it comes in again from the other side.
    """

    level: Float[Tensor, "b c H W"]
    """The scene, but for a constant; the sensor sees the first rows and columns."""
    own: Float[Tensor, "b c h w"]
    """What each pixel says of it by itself: the sum of its events, less what is known of its error."""
    explained: Float[Tensor, "b 4 H F"]
    """By how much the errors' variances are smaller than at the start, for each spatial frequency: that of `level`,
    that of `own`, and real and imaginary part of their covariance."""


def nothing_seen(like: Float[Tensor, "b c h w"], margin: int) -> Picture:
    """The picture at the start, for images of this size and at least so many pixels beyond them."""
    b, c, h, w = like.shape
    height, width = _round(h + margin), _round(w + margin)
    explained = like.new_zeros(b, 4, height, width // 2 + 1)
    return Picture(like.new_zeros(b, c, height, width), like.new_zeros(b, c, h, w), explained)


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


def follow(changes: Float[Tensor, "b c h w"], motion: Motion, picture: Picture, memory: Memory) -> Picture:
    """The picture one window later. Where no motion was found, all that changes is taken for the scene's.

    With m = exp(i f d) and variances L of `level`, O of `own`, covariance C: `level` and C move by m; then, for the
    difference r of the images, S = L + O - 2 Re C + noise, `level` gains (L - C) / S r and `own` loses (O - C*) / S r.
    """
    height, width = changes.shape[-2:]
    size = (picture.level.shape[-2], picture.level.shape[-1])
    beyond = (0, size[1] - width, 0, size[0] - height)
    move, found = _move(motion, size), motion.found[:, None, None, None]
    expected = _expected(size, memory, changes)
    level = torch.fft.irfft2(torch.fft.rfft2(picture.level) * move, s=size)
    level = level * F.pad(level.new_ones(height, width), beyond, value=memory.fade)
    own = picture.own + changes

    frame = motion.displacement.new_tensor([width, height])
    entered = (motion.displacement.abs() / frame).sum(-1).clamp(max=1)[:, None, None, None]
    kept = 1 - memory.renewal * entered
    of_level, of_own, real, imaginary = (expected - picture.explained).split(1, dim=1)
    of_level = expected[0] + kept.square() * (of_level - expected[0])
    of_own = of_own + memory.drift
    of_both = torch.complex(real, imaginary) * move * kept
    level_alone, own_alone = of_level - of_both, of_own - of_both  # the second is the conjugate of what corrects `own`
    spread = level_alone.real + own_alone.real + memory.noise

    difference = own - level[..., :height, :width]
    spectrum = torch.fft.rfft2(F.pad(difference, beyond)) / spread
    to_level = torch.fft.irfft2(spectrum * level_alone, s=size)
    to_own = torch.fft.irfft2(spectrum * own_alone.conj(), s=size)[..., :height, :width]
    of_both = of_both + level_alone * own_alone / spread
    variances = [
        of_level - level_alone.abs().square() / spread,
        of_own - own_alone.abs().square() / spread,
        of_both.real,
        of_both.imag,
    ]
    explained = expected - torch.cat(variances, dim=1)

    alike = memory.fade * picture.explained[:, 1:2]
    still = Picture(
        level + F.pad(difference, beyond), own, torch.cat([alike, alike, alike, torch.zeros_like(alike)], dim=1)
    )
    followed = Picture(level + to_level, own - to_own, explained)
    return Picture(*(torch.where(found, a, b) for a, b in zip(followed, still, strict=True)))


def certainty(picture: Picture, memory: Memory) -> Float[Tensor, "b 1 1 1"]:
    """How much of what a picture can be is known, from 0 to 1: the mean over all frequencies."""
    size = (picture.level.shape[-2], picture.level.shape[-1])
    share = picture.explained[:, :1] / _expected(size, memory, picture.level)[:1]
    return share.clamp(0, 1).mean((-1, -2), keepdim=True)


def _expected(size: tuple[int, int], memory: Memory, like: Tensor) -> Float[Tensor, "4 H F"]:
    """The four numbers of each frequency that `Picture.explained` counts from: both errors are minus the picture."""
    down, across = _frequencies(size, like)
    lowest = (2 * math.pi / max(size)) ** 2
    variance = memory.prior / (down.square() + across.square()).clamp(min=lowest)
    return torch.stack([variance, variance, variance, torch.zeros_like(variance)])


def _frequencies(size: tuple[int, int], like: Tensor) -> tuple[Float[Tensor, "H 1"], Float[Tensor, " F"]]:
    """Radians a pixel, down and across, in the order of rfft2."""
    rows, columns = (torch.arange(number, device=like.device) for number in (size[0], size[1] // 2 + 1))
    down = 2 * math.pi / size[0] * torch.where(2 * rows < size[0], rows, rows - size[0])[:, None]
    return down, 2 * math.pi / size[1] * columns


def _move(motion: Motion, size: tuple[int, int]) -> Tensor:
    """exp(i f d) for every frequency f, complex [b, 1, H, F]; 1 where no motion was found."""
    d = torch.where(motion.found[:, None], motion.displacement, 0.0)[:, :, None, None, None]
    down, across = _frequencies(size, d)
    angle = across * d[:, 0] + down * d[:, 1]
    return torch.complex(angle.cos(), angle.sin())
