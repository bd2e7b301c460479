"""Similarity of two images, per frame: one definition for the loss and for the table.

Every function takes frames in [0, 1] with any leading axes, gives one number per frame, and is differentiable.
The perceptual distance (LPIPS) has weights to find and lives in polarnet/lpips.py; its names are public here too.
"""

import functools
import math

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.lpips import Lpips, LpipsConfig, lpips_problem

__all__ = [
    "Lpips",
    "LpipsConfig",
    "aolp_error_deg",
    "correlation",
    "gradient_agreement",
    "level_mse",
    "lpips_problem",
    "mse",
    "pattern_mse",
    "psnr",
    "spread_mse",
    "ssim",
]

SSIM_SIGMA = 1.5  # pixels; this and the next three: Wang et al., IEEE TIP 2004
SSIM_RADIUS = 5  # pixels: an 11 x 11 window
SSIM_K1, SSIM_K2 = 0.01, 0.03
LEAST_MSE = 1e-10  # half a step of the stored truth (1/65535) squared is 6e-11: nothing finer is known
LEAST_DEVIATION = 1e-6  # a tenth of a step: a frame that varies less is constant
SOBEL_SMOOTH, SOBEL_SLOPE = (0.25, 0.5, 0.25), (-0.5, 0.0, 0.5)  # across and along; a ramp has its slope per pixel
CHANCE_AOLP_DEG = 45.0  # mean error of an angle that knows nothing: the mean of |d| over -90 ... 90 degrees


def mse(a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """Mean squared error."""
    return (a - b).square().mean(dim=(-2, -1))


def level_mse(a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """Squared error of the frame's mean: the part of `mse` that a constant offset explains."""
    return (a - b).mean(dim=(-2, -1)).square()


def pattern_mse(a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """What remains of `mse` once both frames have the same mean: mse = level_mse + pattern_mse."""
    return mse(_centred(a), _centred(b))


def spread_mse(truth: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """`mse` of the best constant, the frame's own mean: its variance over the pixels, against which skill counts."""
    return _centred(truth).square().mean(dim=(-2, -1))


def psnr(a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """Peak signal-to-noise ratio in dB for the data range 1; 100 dB, not infinity, where the frames agree."""
    return -10 * torch.log10(mse(a, b).clamp(min=LEAST_MSE))


def correlation(a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """Pearson's correlation over the pixels of a frame, in [-1, 1]; 0 where either frame is constant.

    A constant frame shows nothing of the other's pattern, so 0 is its score and no frame is left out.
    """
    dtype = torch.promote_types(a.dtype, b.dtype)
    a, b = _centred(a.double()), _centred(b.double())
    variance = a.square().mean(dim=(-2, -1)) * b.square().mean(dim=(-2, -1))
    varies = (_deviation(a) > LEAST_DEVIATION) & (_deviation(b) > LEAST_DEVIATION)
    covariance = (a * b).mean(dim=(-2, -1))
    return torch.where(varies, covariance / torch.where(varies, variance, 1.0).sqrt(), 0.0).to(dtype)


def gradient_agreement(a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """How well edges agree in place, direction and height: 2 sum(grad a . grad b) / sum(|grad a|^2 + |grad b|^2).

    In [-1, 1]: 1 for the same gradients, 0 where either frame has none, -1 for the negative. An edge half as high
    as it should be costs, which `correlation` forgives. The gradients are Sobel's (smoothed central differences) at
    the interior pixels. The ratio is that of gradient similarity (Liu, Lin & Narwaria, IEEE TIP 2012), here of
    vectors instead of magnitudes, and pooled over the frame before the division, so that it needs no constant.
    ValueError for a frame smaller than 3 pixels.
    """
    if min(a.shape[-2:]) < len(SOBEL_SLOPE):
        raise ValueError(f"gradients need frames of at least 3 pixels a side, got {tuple(a.shape[-2:])}")
    dtype = torch.promote_types(a.dtype, b.dtype)
    gradients = [_sobel(x.double()) for x in (a, b)]
    (a_x, a_y), (b_x, b_y) = gradients
    common = (a_x * b_x + a_y * b_y).sum(dim=(-2, -1))
    energy = [(x.square() + y.square()).sum(dim=(-2, -1)) for x, y in gradients]
    floor = LEAST_DEVIATION**2 * (a.shape[-2] - 2) * (a.shape[-1] - 2)
    varies = (energy[0] > floor) & (energy[1] > floor)
    return torch.where(varies, 2 * common / torch.where(varies, energy[0] + energy[1], 1.0), 0.0).to(dtype)


def aolp_error_deg(
    a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"], weight: Float[Tensor, "*b h w"]
) -> Float[Tensor, "*b"]:
    """Mean of the angle between two AoLP in radians, in degrees [0, 90]: the shorter way round the half circle.

    `weight` is the true DoLP, as an angle matters as much as light is polarized. A frame without any polarization
    has no angle and nobody can be right or wrong: it counts as chance, 45 degrees, so that no frame is left out.
    """
    period = math.pi
    between = ((a - b).double() + period / 2).remainder(period) - period / 2
    weight = weight.double()
    total = weight.sum(dim=(-2, -1))
    mean = (between.abs() * weight).sum(dim=(-2, -1)) / torch.where(total > 0, total, 1.0)
    return torch.where(total > 0, mean.rad2deg(), CHANCE_AOLP_DEG).to(torch.promote_types(a.dtype, b.dtype))


def ssim(a: Float[Tensor, "*b h w"], b: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b"]:
    """Structural similarity (Wang et al. 2004) for the data range 1, Gaussian window of 11 pixels and sigma 1.5.

    The mean over the whole frame, which is mirrored at its borders (the edge pixel is not repeated): torchmetrics'
    `structural_similarity_index_measure`. scikit-image averages the interior alone, where both agree.
    Computed in float32 at least, whatever autocast says: variances are small differences of large means.
    ValueError for a frame smaller than 6 pixels.
    """
    if min(a.shape[-2:]) <= SSIM_RADIUS:
        raise ValueError(f"ssim needs frames of at least {SSIM_RADIUS + 1} pixels a side, got {tuple(a.shape[-2:])}")
    with torch.autocast(a.device.type, enabled=False):
        a, b = (x if x.dtype == torch.float64 else x.float() for x in (a, b))
        mean_a, mean_b, square_a, square_b, product = _gaussian_means(torch.stack([a, b, a * a, b * b, a * b]))
        variance_a = (square_a - mean_a.square()).clamp(min=0)
        variance_b = (square_b - mean_b.square()).clamp(min=0)
        covariance = product - mean_a * mean_b
        luminance = (2 * mean_a * mean_b + SSIM_K1**2) / (mean_a.square() + mean_b.square() + SSIM_K1**2)
        structure = (2 * covariance + SSIM_K2**2) / (variance_a + variance_b + SSIM_K2**2)
        return (luminance * structure).mean(dim=(-2, -1))


def _centred(frames: Tensor) -> Tensor:
    return frames - frames.mean(dim=(-2, -1), keepdim=True)


def _deviation(centred: Tensor) -> Tensor:
    return centred.detach().square().mean(dim=(-2, -1)).sqrt()


def _sobel(frames: Float[Tensor, "*b h w"]) -> tuple[Float[Tensor, "*b i j"], Float[Tensor, "*b i j"]]:
    """(along rows, along columns), per pixel, at the interior pixels."""

    def filtered(x: Tensor, dim: int, taps: tuple[float, ...]) -> Tensor:
        n = x.shape[dim] - len(taps) + 1
        return torch.stack([tap * x.narrow(dim, k, n) for k, tap in enumerate(taps) if tap]).sum(dim=0)

    return (
        filtered(filtered(frames, -1, SOBEL_SLOPE), -2, SOBEL_SMOOTH),
        filtered(filtered(frames, -2, SOBEL_SLOPE), -1, SOBEL_SMOOTH),
    )


def _gaussian_means(frames: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    # As two matrix products this is 8 (forward) to 18 times (with backward) faster on a CPU than two convolutions.
    h, w = frames.shape[-2:]
    rows = _gaussian_matrix(h, frames.dtype, frames.device)
    columns = _gaussian_matrix(w, frames.dtype, frames.device)
    return rows @ (frames @ columns.T)


@functools.lru_cache(maxsize=16)
def _gaussian_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "n n"]:
    """Row i holds the window around pixel i; weights that fall off the border are mirrored back."""
    with torch.inference_mode(False):
        offset = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
        weight = torch.exp(-(offset.double() ** 2) / (2 * SSIM_SIGMA**2))
        source = (torch.arange(size)[:, None] + offset).abs()
        source = torch.where(source < size, source, 2 * (size - 1) - source)
        matrix = torch.zeros(size, size, dtype=torch.float64)
        matrix.scatter_add_(1, source, (weight / weight.sum()).expand(size, -1))
        return matrix.to(device, dtype)
