"""What a predictor that sees no events can score: constants that every table must show beside the methods."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor


def constant(value: float, truth: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """The same DoLP at every pixel of as many frames as `truth` has, whose values are not looked at."""
    return torch.full_like(truth, value)


def oracle_mean(truth: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w"]:
    """Each frame's own mean: no constant can have a smaller squared error. It knows the truth, so it is no method."""
    return truth.mean(dim=(-2, -1), keepdim=True).expand_as(truth).contiguous()


def mean_dolp(sequences: Iterable[Float[Tensor, "n h w"]]) -> float:
    """Mean over all pixels of all frames; ValueError where there are none."""
    total, count = 0.0, 0
    for frames in sequences:
        total, count = total + frames.double().sum().item(), count + frames.numel()
    if count == 0:
        raise ValueError("the mean DoLP needs at least one frame, got none: is the training split empty?")
    return total / count
