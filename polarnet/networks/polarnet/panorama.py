"""Panoramas: log intensities and polarizer contrasts gathered along the motion of the scene, without training.

The sum of a pixel's events measures how much its log intensity has changed since the start. Its initial value is
unknown, and its error grows with every event, because thresholds differ between pixels. A moving scene shows each of
its points to many pixels, which gives two images of it: `own` holds each pixel's sum of events, and `level` moves with
the scene (after a displacement d, a factor exp(i f d) in the Fourier domain). An error of `own` stays at its pixel,
whereas an error of `level` moves. Each image therefore reveals the errors of the other, wherever the scene varies
along its motion. `follow` is the Kalman filter of the two, one for each spatial frequency; both start at 0.

Such registration also removes the fixed pattern of infrared sensors (Hardie et al., Applied Optics 2000). Mosaicing
with event cameras (Kim et al., BMVC 2014) filters pixel by pixel instead. Lengths are in pixels of the input images,
log intensities in steps, the contrast threshold of an event.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional as F

from polarnet.networks.polarnet import kernels

MAX_EVENTS = 6.0  # limit per pixel and window in the motion search, so that a hot pixel cannot dominate
MIN_CORRELATION = 0.1  # smallest normalised correlation of two windows at which a motion is accepted
MIN_OVERLAP = 0.1  # lower limit of the overlap, along each axis, that the correlation is divided by
ROUND = 16  # sizes are rounded up to multiples of this, for fast Fourier transforms


class Memory(NamedTuple):
    """Parameters of the Kalman filter `follow`; variances are those of white noise, in squared steps."""

    prior: float
    """Prior variance of the scene at a frequency of 1 radian per pixel; it falls with the square of the frequency."""
    noise: float
    """Variance of a pixel's sum of events, independent in each window, for example from rounding to whole steps."""
    drift: float
    """Variance that each window adds to the error of a pixel's sum of events."""
    renewal: float
    """Loss of certainty, over the whole image, per fraction of the image that a displacement replaces."""
    fade: float
    """Factor per window for parts of the panorama out of sight, and for the certainty without a reliable motion."""


class Motion(NamedTuple):
    """Motion of the scene from one window to the next."""

    displacement: Float[Tensor, "*n 2"]
    """(x, y): the point now at p was at p + displacement one window earlier."""
    reliable: Bool[Tensor, "*n"]
    """Whether the correlation of the two windows confirms the motion."""


class Panorama(NamedTuple):
    """State of the filter `follow`; all zeros at the start."""

    level: Float[Tensor, "b c H W"]
    """The panorama, up to a constant; the sensor covers the first rows and columns. It wraps around: parts of the scene
    that leave the sensor fade in the margin before they re-enter from the opposite side."""
    own: Float[Tensor, "b c h w"]
    """Each pixel's own estimate of the scene: the sum of its events minus its estimated error."""
    explained: Float[Tensor, "b 4 H F"]
    """Reduction of the error variances since the start, for each spatial frequency: of `level`, of `own`, and the real
    and imaginary part of their covariance."""


def empty_panorama(like: Float[Tensor, "b c h w"], margin: int) -> Panorama:
    """Return the initial state for images of the size of `like`, with a margin of at least `margin` pixels."""
    b, c, h, w = like.shape
    height, width = (-(-(side + margin) // ROUND) * ROUND for side in (h, w))
    explained = like.new_zeros(b, 4, height, width // 2 + 1)
    return Panorama(like.new_zeros(b, c, height, width), like.new_zeros(b, c, h, w), explained)


def displacements(images: Float[Tensor, "t1 b h w"], reach: int) -> Motion:
    """Find the displacements [t, b], up to `reach` along each axis, of best correlation between consecutive windows.

    A parabola through the maximum and its neighbours gives subpixel precision.
    """
    height, width = images.shape[-2:]
    images = images.clamp(-MAX_EVENTS, MAX_EVENTS)
    # large enough to avoid wrap-around and to hold every displacement of the search
    size = [next_fast_len(max(side, reach + 2) + reach + 1, real=True) for side in (height, width)]
    spectrum = torch.fft.rfft2(images, s=size)
    correlation = torch.fft.irfft2(spectrum[:-1] * spectrum[1:].conj(), s=size)
    correlation = torch.roll(correlation, (reach + 1, reach + 1), (-2, -1))
    side = 2 * reach + 1
    steps = torch.arange(-reach - 1, reach + 2, device=images.device).abs()
    overlap = (1 - steps / height).clamp(min=MIN_OVERLAP)[:, None] * (1 - steps / width).clamp(min=MIN_OVERLAP)
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
    return Motion(torch.stack([x, y], dim=-1), middle > MIN_CORRELATION * (energy[:-1] * energy[1:]).clamp(min=1e-6))


def _vertex(left: Float[Tensor, "*n"], middle: Float[Tensor, "*n"], right: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the position in [-1/2, 1/2] of the vertex of the parabola through values at -1, 0 and 1."""
    bend = (2 * middle - left - right).clamp(min=1e-12)
    return ((right - left) / (2 * bend)).clamp(-0.5, 0.5)


def follow(changes: Float[Tensor, "b c h w"], motion: Motion, panorama: Panorama, memory: Memory) -> Panorama:
    """Advance the panorama by one window. Without a reliable motion, all changes are attributed to the scene.

    Let m = exp(i f d), let L and O be the variances of `level` and `own`, and C their covariance. First, `level` and C
    are multiplied by m. Then, with the difference r = own - level and S = L + O - 2 Re C + noise, the update adds
    (L - C) / S r to `level` and subtracts (O - C*) / S r from `own`.
    """
    height, width = changes.shape[-2:]
    size = (panorama.level.shape[-2], panorama.level.shape[-1])
    beyond = (0, size[1] - width, 0, size[0] - height)
    own = panorama.own + changes
    in_sight = F.pad(own.new_ones(height, width), beyond, value=memory.fade)
    own_explained = memory.fade * panorama.explained[:, 1:2]
    still_explained = torch.cat([*[own_explained] * 3, torch.zeros_like(own_explained)], dim=1)
    if kernels.compiled_path(changes) and not motion.reliable.any():  # the result needs no transforms
        level = panorama.level * in_sight
        return Panorama(level + F.pad(own - level[..., :height, :width], beyond), own, still_explained)
    shift, reliable = _shift(motion, size), motion.reliable[:, None, None, None]
    expected = _expected(size, memory, changes)
    level = torch.fft.irfft2(torch.fft.rfft2(panorama.level) * shift, s=size) * in_sight

    across, down = motion.displacement.abs().unbind(-1)
    entered = (across / width + down / height).clamp(max=1)[:, None, None, None]
    remaining = 1 - memory.renewal * entered
    of_level, of_own, real, imaginary = (expected - panorama.explained).split(1, dim=1)
    of_level = expected[0] + remaining.square() * (of_level - expected[0])
    of_own = of_own + memory.drift
    of_both = torch.complex(real, imaginary) * shift * remaining
    level_alone, own_alone = of_level - of_both, of_own - of_both  # `own` is corrected with the conjugate of own_alone
    spread = level_alone.real + own_alone.real + memory.noise

    difference = own - level[..., :height, :width]
    spectrum = torch.fft.rfft2(F.pad(difference, beyond)) / spread
    to_level = torch.fft.irfft2(spectrum * level_alone, s=size)
    to_own = torch.fft.irfft2(spectrum * own_alone.conj(), s=size)[..., :height, :width]
    of_both = of_both + level_alone * own_alone / spread
    of_level = of_level - level_alone.abs().square() / spread
    of_own = of_own - own_alone.abs().square() / spread
    explained = expected - torch.cat([of_level, of_own, of_both.real, of_both.imag], dim=1)

    still = Panorama(level + F.pad(difference, beyond), own, still_explained)
    followed = Panorama(level + to_level, own - to_own, explained)
    return Panorama(*(torch.where(reliable, a, b) for a, b in zip(followed, still, strict=True)))


def certainty(panorama: Panorama, memory: Memory) -> Float[Tensor, "b 1 1 1"]:
    """Return the share of the prior variance that is explained, from 0 to 1, as a mean over all frequencies."""
    height, width = panorama.level.shape[-2:]
    share = panorama.explained[:, :1] / _expected((height, width), memory, panorama.level)[:1]
    return share.clamp(0, 1).mean((-1, -2), keepdim=True)


def _expected(size: tuple[int, int], memory: Memory, like: Tensor) -> Float[Tensor, "4 H F"]:
    """Return the error variances and covariance at the start, when both errors equal minus the scene."""
    down, across = _frequencies(size, like)
    lowest = (2 * math.pi / max(size)) ** 2
    variance = memory.prior / (down.square() + across.square()).clamp(min=lowest)
    return torch.stack([variance, variance, variance, torch.zeros_like(variance)])


def _frequencies(size: tuple[int, int], like: Tensor) -> tuple[Float[Tensor, "H 1"], Float[Tensor, " F"]]:
    """Return vertical and horizontal frequencies in radians per pixel, in the order of rfft2."""
    rows, columns = (torch.arange(number, device=like.device) for number in (size[0], size[1] // 2 + 1))
    down = 2 * math.pi / size[0] * torch.where(2 * rows < size[0], rows, rows - size[0])[:, None]
    return down, 2 * math.pi / size[1] * columns


def _shift(motion: Motion, size: tuple[int, int]) -> Tensor:
    """Return exp(i f d) for every frequency f, complex [b, 1, H, F]; 1 without a reliable motion."""
    d = torch.where(motion.reliable[:, None], motion.displacement, 0.0)[:, :, None, None, None]
    down, across = _frequencies(size, d)
    angle = across * d[:, 0] + down * d[:, 1]
    return torch.complex(angle.cos(), angle.sin())
