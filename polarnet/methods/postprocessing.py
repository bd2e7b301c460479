"""What E2VID's authors do to reconstructed images before they show them (their public code): switchable, and recorded.

Their images are then rounded to 8 bits; these are not.
"""

from dataclasses import dataclass, field
from statistics import NormalDist

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from polarnet.ranges import allowed, check_ranges

KERNEL_SIZE = 5  # pixels of the blur behind the unsharp mask
DARKEST_AT_MOST = 0.45  # bounds of the automatic range, so that it spans at least 0.1
BRIGHTEST_AT_LEAST = 0.55


@dataclass(frozen=True)
class PostprocessingConfig:
    """Section `baselines.postprocessing` of params.yaml; the published defaults."""

    unsharp_amount: float = field(metadata=allowed(low=0))
    """Of what a blurred copy lacks, added to the image; 0: nothing."""
    unsharp_sigma: float = field(metadata=allowed(above=0))
    """Of the blur, in the published kernel's units."""
    auto_hdr: bool
    """Stretch the range of the images to [0, 1]."""
    auto_hdr_frames: int = field(metadata=allowed(low=1))
    """The range is the median over so many frames, the present one the last."""
    auto_hdr_per_polarizer: bool
    """A range for each polarizer, which loses the ratios that Stokes parameters need; false: one for the four."""

    def __post_init__(self):
        check_ranges(self)


def postprocessed(images: Float[Tensor, "t c h w"], config: PostprocessingConfig) -> Float[Tensor, "t c h w"]:
    """Sharpened, brought to [0, 1] by the automatic range if wanted, and clipped to it."""
    return stretched(unsharp_masked(images, config.unsharp_amount, config.unsharp_sigma), config)


def stretched(sharp: Float[Tensor, "t c h w"], config: PostprocessingConfig) -> Float[Tensor, "t c h w"]:
    """Sharpened images, brought to [0, 1] by the automatic range if wanted, and clipped to it."""
    if config.auto_hdr:
        low, high = _range(sharp, config.auto_hdr_frames, per_channel=config.auto_hdr_per_polarizer)
        sharp = (sharp - low) / (high - low)
    return sharp.clamp(0, 1)


def unsharp_masked(images: Float[Tensor, "t c h w"], amount: float, sigma: float) -> Float[Tensor, "t c h w"]:
    """(1 + amount) image - amount blurred; beyond the border the image is mirrored."""
    if amount == 0:
        return images
    kernel = blur_kernel(sigma).to(images)[None, None]
    margin = KERNEL_SIZE // 2
    padded = F.pad(images.flatten(0, 1)[:, None], (margin,) * 4, mode="reflect")
    return (1 + amount) * images - amount * F.conv2d(padded, kernel).view_as(images)


def blur_kernel(sigma: float) -> Float[Tensor, "5 5"]:
    """The published kernel: the root of the outer product of a normal distribution's shares of 5 bins, sum 1.

    The bins lie in [-sigma - step / 2, sigma + step / 2] of the standard normal, step = (2 sigma + 1) / 5.
    """
    step = (2 * sigma + 1) / KERNEL_SIZE
    edges = torch.linspace(-sigma - step / 2, sigma + step / 2, KERNEL_SIZE + 1, dtype=torch.float64)
    shares = torch.tensor([NormalDist().cdf(edge) for edge in edges.tolist()], dtype=torch.float64).diff()
    kernel = torch.outer(shares, shares).sqrt()
    return kernel / kernel.sum()


def _range(images: Float[Tensor, "t c h w"], frames: int, *, per_channel: bool) -> tuple[Tensor, Tensor]:
    over = (-2, -1) if per_channel else (-3, -2, -1)
    low = images.amin(over, keepdim=True).clamp(0, DARKEST_AT_MOST)
    high = images.amax(over, keepdim=True).clamp(BRIGHTEST_AT_LEAST, 1)
    return _running_median(low, frames), _running_median(high, frames)


def _running_median(values: Float[Tensor, "t *rest"], frames: int) -> Float[Tensor, "t *rest"]:
    windows = (values[max(0, last + 1 - frames) : last + 1] for last in range(len(values)))
    return torch.stack([window.quantile(0.5, dim=0) for window in windows])
