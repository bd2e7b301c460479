"""Similarity of two images, per frame: one definition for the loss and for the table.

Every function takes frames in [0, 1], numpy or torch, with any leading axes, returns one number per frame, and is
differentiable. TypeError for anything but an array; ValueError for integers, and for frames or masks of different
shapes. Where the data range matters (`psnr`, `ssim`), ValueError also for a second frame, the truth, outside [0, 1].

With a mask `valid`, values at other pixels do not matter, and a frame without any valid pixel gives NaN, except in
`gradient_agreement` (0) and `aolp_error_deg` (45 degrees).

The perceptual distance, `Lpips`, is a network and lives in polarnet/metrics/lpips.py.
"""

import functools
import math
from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.runtime import arrays
from polarnet.runtime.arrays import Array
from polarnet.stokes import Prediction

Valid = Bool[Array, "*b h w"] | None

SSIM_SIGMA = 1.5  # pixels; this and the next three: Wang et al., IEEE TIP 2004
SSIM_RADIUS = 5  # pixels: an 11 x 11 kernel
SSIM_K1, SSIM_K2 = 0.01, 0.03
MIN_MSE = 1e-10  # half a step of the stored truth (1/65535) squared is 6e-11: nothing finer is known
MIN_DEVIATION = 1e-6  # a tenth of a step: a frame with a smaller deviation counts as constant
SOBEL_SMOOTH, SOBEL_SLOPE = (0.25, 0.5, 0.25), (-0.5, 0.0, 0.5)  # across and along; a ramp gives its slope
CHANCE_AOLP_DEG = 45.0  # mean error of a random angle: the mean of |d| over -90 ... 90 degrees


def mean_where(values: Float[Tensor, "*b h w"], valid: Bool[Tensor, "*b h w"] | None) -> Float[Tensor, "*b"]:
    """Mean over the valid pixels of a frame; over all where `valid` is None."""
    if valid is None:
        return values.mean(dim=(-2, -1))
    return torch.where(valid, values, 0.0).sum(dim=(-2, -1)) / valid.sum(dim=(-2, -1))


def with_truth_outside(
    predicted: Float[Tensor, "*b h w"], truth: Float[Tensor, "*b h w"], valid: Bool[Tensor, "*b h w"] | None
) -> Float[Tensor, "*b h w"]:
    """`predicted` at valid pixels and `truth` at the others, which add no error to SSIM and LPIPS."""
    return predicted if valid is None else torch.where(valid, predicted, truth)


def mse(a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], valid: Valid = None) -> Float[Tensor, "*b"]:
    """Mean squared error.

    >>> import torch
    >>> from polarnet.metrics import mse
    >>> mse(torch.zeros(2, 16, 16), torch.full((2, 16, 16), 0.5))
    tensor([0.2500, 0.2500])
    """
    (a, b), valid = _checked(valid, a=a, b=b)
    return mean_where((a - b).square(), valid)


def level_mse(a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], valid: Valid = None) -> Float[Tensor, "*b"]:
    """Squared error of the frame's mean: the part of `mse` that a constant offset explains."""
    (a, b), valid = _checked(valid, a=a, b=b)
    return mean_where(a - b, valid).square()


def pattern_mse(a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], valid: Valid = None) -> Float[Tensor, "*b"]:
    """Remainder of `mse` after both frames get the same mean: mse = level_mse + pattern_mse."""
    (a, b), valid = _checked(valid, a=a, b=b)
    return mse(_centred(a, valid), _centred(b, valid), valid)


def spread_mse(truth: Float[Array, "*b h w"], valid: Valid = None) -> Float[Tensor, "*b"]:
    """`mse` of the best constant, the frame's own mean: the variance over its pixels, and the reference for skill."""
    (truth,), valid = _checked(valid, truth=truth)
    return mean_where(_centred(truth, valid).square(), valid)


def psnr(a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], valid: Valid = None) -> Float[Tensor, "*b"]:
    """Peak signal-to-noise ratio in dB for the data range 1; 100 dB, not infinity, for equal frames.

    >>> import torch
    >>> from polarnet.metrics import psnr
    >>> round(psnr(torch.full((16, 16), 0.1), torch.zeros(16, 16)).item(), 2)
    20.0
    """
    (a, b), valid = _checked(valid, a=a, b=b)
    _check_unit(b, valid)
    return -10 * torch.log10(mse(a, b, valid).clamp(min=MIN_MSE))


def correlation(a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], valid: Valid = None) -> Float[Tensor, "*b"]:
    """Pearson's correlation over the pixels of a frame, in [-1, 1]; 0 where either frame is constant.

    A constant frame shows nothing of the other's pattern, so its score is 0 and no frame is left out.
    """
    (a, b), valid = _checked(valid, a=a, b=b)
    dtype = torch.promote_types(a.dtype, b.dtype)
    a, b = _centred(a.double(), valid), _centred(b.double(), valid)
    covariance, variance_a, variance_b = (mean_where(x, valid) for x in (a * b, a.square(), b.square()))
    varies = (variance_a.sqrt() > MIN_DEVIATION) & (variance_b.sqrt() > MIN_DEVIATION)
    variance = torch.where(varies, variance_a * variance_b, 1.0)
    constant = 0.0 if valid is None else torch.where(valid.any(-1).any(-1), 0.0, torch.nan)
    return torch.where(varies, covariance / variance.sqrt(), constant).to(dtype)


def gradient_agreement(
    a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], valid: Valid = None
) -> Float[Tensor, "*b"]:
    """Agreement of edges in place, direction and height: 2 sum(grad a . grad b) / sum(|grad a|^2 + |grad b|^2).

    The range is [-1, 1]: 1 for the same gradients, 0 where either frame has none, -1 for opposite gradients. An edge of
    half the true height lowers the score, unlike in `correlation`. The gradients are Sobel's at the interior pixels
    (with a mask: those whose eight neighbours are valid as well), pooled over the frame before the division (after Liu,
    Lin & Narwaria, IEEE TIP 2012). ValueError for a frame smaller than 3 pixels.
    """
    (a, b), valid = _checked(valid, a=a, b=b)
    if min(a.shape[-2:]) < len(SOBEL_SLOPE):
        raise ValueError(f"gradients need frames of at least 3 pixels a side, got {tuple(a.shape[-2:])}")
    dtype = torch.promote_types(a.dtype, b.dtype)
    interior = None if valid is None else valid.unfold(-2, 3, 1).unfold(-2, 3, 1).flatten(-2).all(-1)
    (a_x, a_y), (b_x, b_y) = (_sobel(x.double()) for x in (a, b))
    products = torch.stack([a_x * b_x + a_y * b_y, a_x.square() + a_y.square(), b_x.square() + b_y.square()])
    if interior is not None:
        products = torch.where(interior, products, 0.0)
    common, energy_a, energy_b = products.sum(dim=(-2, -1))
    floor = MIN_DEVIATION**2 * a_x.shape[-2] * a_x.shape[-1]
    varies = (energy_a > floor) & (energy_b > floor)
    return torch.where(varies, 2 * common / torch.where(varies, energy_a + energy_b, 1.0), 0.0).to(dtype)


def aolp_error_deg(
    a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], weight: Float[Array, "*b h w"], valid: Valid = None
) -> Float[Tensor, "*b"]:
    """Mean angle between two AoLP (radians), in degrees [0, 90], the shorter way round the half circle.

    `weight` is the true DoLP: an angle matters in proportion to it. A frame without any polarization has no angle; it
    scores as chance, 45 degrees, so that no frame is left out.
    """
    (a, b, weight), valid = _checked(valid, a=a, b=b, weight=weight)
    period = math.pi
    between = ((a - b).double() + period / 2).remainder(period) - period / 2
    counted = weight.double() if valid is None else torch.where(valid, weight.double(), 0.0)
    total = counted.sum(dim=(-2, -1))
    mean = (between.abs() * counted).sum(dim=(-2, -1)) / torch.where(total > 0, total, 1.0)
    return torch.where(total > 0, mean.rad2deg(), CHANCE_AOLP_DEG).to(torch.promote_types(a.dtype, b.dtype))


def ssim(a: Float[Array, "*b h w"], b: Float[Array, "*b h w"], valid: Valid = None) -> Float[Tensor, "*b"]:
    """Structural similarity (Wang et al. 2004) for the data range 1, with a Gaussian kernel of 11 pixels and sigma 1.5.

    The mean covers the whole frame, which is mirrored at its borders (the edge pixel is not repeated), as in
    torchmetrics' `structural_similarity_index_measure`; with a mask, it covers the valid pixels, and kernels that reach
    invalid pixels use the truth `b` for `a` there. Computed in float32 at least, even under autocast: variances are
    small differences of large means. ValueError for a frame smaller than 6 pixels.

    >>> import torch
    >>> from polarnet.metrics import ssim
    >>> frame = torch.linspace(0, 1, 256).view(16, 16)
    >>> round(ssim(frame, frame).item(), 3)
    1.0
    """
    (a, b), valid = _checked(valid, a=a, b=b)
    _check_unit(b, valid)
    if min(a.shape[-2:]) <= SSIM_RADIUS:
        raise ValueError(f"ssim needs frames of at least {SSIM_RADIUS + 1} pixels a side, got {tuple(a.shape[-2:])}")
    with torch.autocast(a.device.type, enabled=False):
        a, b = (x if x.dtype == torch.float64 else x.float() for x in (with_truth_outside(a, b, valid), b))
        mean_a, mean_b, square_a, square_b, product = _gaussian_means(torch.stack([a, b, a * a, b * b, a * b]))
        variance_a = (square_a - mean_a.square()).clamp(min=0)
        variance_b = (square_b - mean_b.square()).clamp(min=0)
        covariance = product - mean_a * mean_b
        luminance = (2 * mean_a * mean_b + SSIM_K1**2) / (mean_a.square() + mean_b.square() + SSIM_K1**2)
        structure = (2 * covariance + SSIM_K2**2) / (variance_a + variance_b + SSIM_K2**2)
        return mean_where(luminance * structure, valid)


def frame_scores(
    prediction: Prediction,
    dolp: Float[Tensor, "n h w"],
    aolp: Float[Tensor, "n h w"],
    valid: Bool[Tensor, "n h w"] | None = None,
) -> Mapping[str, Float[Tensor, " n"]]:
    """Scores of each frame as in the benchmark: mse, psnr, ssim, corr and, if an angle is predicted, aolp_deg.

    `oracle_mse` is no score, but the MSE of the true frame's own mean (`spread_mse`).

    >>> import torch
    >>> from polarnet.metrics import frame_scores
    >>> from polarnet.stokes import Prediction
    >>> truth = torch.full((2, 16, 16), 0.5)
    >>> frame_scores(Prediction(truth), truth, truth)["mse"]
    tensor([0., 0.])
    """
    scores = {
        "mse": mse(prediction.dolp, dolp, valid),
        "psnr": psnr(prediction.dolp, dolp, valid),
        "ssim": ssim(prediction.dolp, dolp, valid),
        "corr": correlation(prediction.dolp, dolp, valid),
    }
    if prediction.aolp is not None:
        scores["aolp_deg"] = aolp_error_deg(prediction.aolp, aolp, dolp, valid)
    return {**scores, "oracle_mse": spread_mse(dolp, valid)}


def _checked(valid: Valid, **frames: Array) -> tuple[list[Tensor], Tensor | None]:
    """Frames, checked to be floating-point and of one shape, and their mask, as tensors."""
    tensors = {name: arrays.as_tensor(name, values) for name, values in frames.items()}
    for name, values in tensors.items():
        arrays.check_shape(name, values, "... height width")
        arrays.check_floating(name, values)
    arrays.check_same_shape(tensors)
    first, *others = tensors.values()
    return [first, *others], None if valid is None else arrays.mask_of("valid", valid, first.shape)


def _check_unit(truth: Tensor, valid: Tensor | None) -> None:
    """ValueError for a truth outside [0, 1]; a prediction may exceed it."""
    arrays.check_range("b", truth if valid is None else torch.where(valid, truth, 0.0), 0, 1, "frames")


def _centred(frames: Tensor, valid: Tensor | None) -> Tensor:
    return frames - mean_where(frames, valid)[..., None, None]


def _sobel(frames: Float[Tensor, "*b h w"]) -> tuple[Float[Tensor, "*b i j"], Float[Tensor, "*b i j"]]:
    """Gradients (along rows, along columns) per pixel, at the interior pixels."""

    def gradient(along: int, across: int) -> Tensor:
        x = frames
        for dim, taps in ((along, SOBEL_SLOPE), (across, SOBEL_SMOOTH)):
            n = x.shape[dim] - len(taps) + 1
            x = torch.stack([tap * x.narrow(dim, k, n) for k, tap in enumerate(taps) if tap]).sum(dim=0)
        return x

    return gradient(-1, -2), gradient(-2, -1)


def _gaussian_means(frames: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    # On a CPU two matrix products are 8 (forward) to 18 times (with backward) faster than two convolutions.
    h, w = frames.shape[-2:]
    rows, columns = (_gaussian_matrix(size, frames.dtype, frames.device) for size in (h, w))
    return rows @ (frames @ columns.T)


@functools.lru_cache(maxsize=16)
def _gaussian_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "n n"]:
    """Row i holds the kernel around pixel i; weights beyond the border are mirrored back."""
    with torch.inference_mode(False):
        offset = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1)
        weight = torch.exp(-(offset.double() ** 2) / (2 * SSIM_SIGMA**2))
        source = (torch.arange(size)[:, None] + offset).abs()
        source = torch.where(source < size, source, 2 * (size - 1) - source)
        matrix = torch.zeros(size, size, dtype=torch.float64)
        matrix.scatter_add_(1, source, (weight / weight.sum()).expand(size, -1))
        return matrix.to(device, dtype)
