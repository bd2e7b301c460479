"""What a predictor that sees no events can score: constants that every table must show beside the methods."""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def constant(value: float, truth: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """The same DoLP at every pixel of as many frames as `truth` has, whose values are not looked at."""
    return torch.full_like(truth, value)


def oracle_mean(truth: Float[Tensor, "n h w"], valid: Bool[Tensor, "n h w"] | None = None) -> Float[Tensor, "n h w"]:
    """Each frame's own mean: no constant can have a smaller squared error. It knows the truth, so it is no method.

    Of the valid pixels, since no others are scored; 0 in a frame that has none.
    """
    if valid is None:
        mean = truth.mean(dim=(-2, -1), keepdim=True)
    else:
        count = valid.sum(dim=(-2, -1), keepdim=True).clamp(min=1)
        mean = torch.where(valid, truth, 0.0).sum(dim=(-2, -1), keepdim=True) / count
    return mean.expand_as(truth).contiguous()


def mean_dolp(sequences: Iterable[Float[Tensor, "*pixels"]]) -> float:
    """Mean over all pixels of all sequences; ValueError where there are none."""
    total, count = 0.0, 0
    for frames in sequences:
        total, count = total + frames.double().sum().item(), count + frames.numel()
    if count == 0:
        raise ValueError("the mean DoLP needs at least one frame, got none: is the training split empty?")
    return total / count
