"""Post-processing of reconstructed images from the public code of E2VID's authors: an unsharp mask, then clipping.

The authors then round images to 8 bits; polarnet does not.
"""

from statistics import NormalDist

import torch
from jaxtyping import Float
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor
from torch.nn import functional as F

from polarnet.runtime.sections import section

KERNEL_SIZE = 5  # blur kernel of the unsharp mask, pixels


@section
class SharpeningConfig:
    """Section `methods.sharpening` of params.yaml; the published defaults."""

    unsharp_amount: NonNegativeFloat
    """Factor on the difference between image and blurred copy, which is added to the image; 0: off."""
    unsharp_sigma: PositiveFloat
    """Width of the blur, in the units of the published kernel."""


def sharpened(images: Float[Tensor, "t c h w"], config: SharpeningConfig) -> Float[Tensor, "t c h w"]:
    """Sharpen images and clip them to [0, 1]."""
    return unsharp_masked(images, config.unsharp_amount, config.unsharp_sigma).clamp(0, 1)


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
