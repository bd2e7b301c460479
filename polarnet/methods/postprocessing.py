"""Post-processing of reconstructed images from the public code of E2VID's authors.

Each step can be switched off, and the settings are recorded. The authors then round images to 8 bits; polarnet does
not.
"""

from dataclasses import dataclass, field
from statistics import NormalDist

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from polarnet.runtime.ranges import allowed, check_ranges

KERNEL_SIZE = 5  # blur kernel of the unsharp mask, pixels
DARKEST_AT_MOST = 0.45  # bounds of the automatic range, so that it spans at least 0.1
BRIGHTEST_AT_LEAST = 0.55


@dataclass(frozen=True)
class PostprocessingConfig:
    """Section `baselines.postprocessing` of params.yaml; the published defaults."""

    unsharp_amount: float = field(metadata=allowed(low=0))
    """Factor on the difference between image and blurred copy, which is added to the image; 0: off."""
    unsharp_sigma: float = field(metadata=allowed(above=0))
    """Width of the blur, in the units of the published kernel."""
    auto_hdr: bool
    """Stretch the range of the images to [0, 1]."""
    auto_hdr_frames: int = field(metadata=allowed(low=1))
    """Number of frames for the median of the range, up to and including the present frame."""
    auto_hdr_per_polarizer: bool
    """One range per channel, which loses the ratios that Stokes parameters need; false: one range for all four."""

    def __post_init__(self):
        check_ranges(self)


def postprocessed(images: Float[Tensor, "t c h w"], config: PostprocessingConfig) -> Float[Tensor, "t c h w"]:
    """Sharpen images, stretch them to [0, 1] if `auto_hdr` is set, and clip them."""
    return stretched(unsharp_masked(images, config.unsharp_amount, config.unsharp_sigma), config)


def stretched(sharp: Float[Tensor, "t c h w"], config: PostprocessingConfig) -> Float[Tensor, "t c h w"]:
    """Stretch sharpened images to [0, 1] if `auto_hdr` is set, and clip them."""
    if config.auto_hdr:
        low, high = _range(sharp, config.auto_hdr_frames, per_channel=config.auto_hdr_per_polarizer)
        sharp = (sharp - low) / (high - low)
    return sharp.clamp(0, 1)


def unsharp_masked(images: Float[Tensor, "t c h w"], amount: float, sigma: float) -> Float[Tensor, "t c h w"]:
    """Unsharp mask: (1 + amount) image - amount blurred, with the image mirrored at its border."""
    if amount == 0:
        return images
    kernel = blur_kernel(sigma).to(images)[None, None]
    margin = KERNEL_SIZE // 2
    padded = F.pad(images.flatten(0, 1)[:, None], (margin,) * 4, mode="reflect")
    return (1 + amount) * images - amount * F.conv2d(padded, kernel).view_as(images)


def blur_kernel(sigma: float) -> Float[Tensor, "5 5"]:
    """The published kernel: square root of the outer product of 5 normal bin probabilities, with sum 1.

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
