"""Reference rows: constants, which see no events, and the oracle mean, which sees the truth. None is a method."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.benchmark.sequences import TestSequence
from polarnet.stokes import Prediction


@dataclass(frozen=True)
class Reference:
    """A row beside the methods, with constant DoLP over a frame; `polarnet.reports.legend` has its label."""

    name: str
    predict: Callable[[TestSequence, float | None], Prediction]
    """Sequence and mean DoLP of the training split -> one frame per window."""
    needs_train_mean: bool = False


def zeros(sequence: TestSequence, train_mean: float | None) -> Prediction:
    """DoLP of 0 everywhere."""
    return Prediction(torch.zeros_like(sequence.dolp))


def train_mean(sequence: TestSequence, train_mean: float | None) -> Prediction:
    """The mean DoLP of the training split everywhere; ValueError if it is unknown."""
    if train_mean is None:
        raise ValueError(
            "the row train_mean needs the mean DoLP of a training split, got none; run `dvc repro synthesize`"
        )
    return Prediction(torch.full_like(sequence.dolp, train_mean))


def own_mean(sequence: TestSequence, train_mean: float | None) -> Prediction:
    """The best constant for each frame, computed from the truth."""
    return Prediction(oracle_mean(sequence.dolp, sequence.valid))


REFERENCES = {
    row.name: row
    for row in (
        Reference("zeros", zeros),
        Reference("train_mean", train_mean, needs_train_mean=True),
        Reference("oracle_mean", own_mean),
    )
}
"""Reference by name, in the order of all tables."""


def oracle_mean(truth: Float[Tensor, "n h w"], valid: Bool[Tensor, "n h w"] | None = None) -> Float[Tensor, "n h w"]:
    """Mean of each frame: the constant with the smallest squared error.

    Only valid pixels count, as in the scores; a frame without valid pixels gets 0.
    """
    if valid is None:
        mean = truth.mean(dim=(-2, -1), keepdim=True)
    else:
        count = valid.sum(dim=(-2, -1), keepdim=True).clamp(min=1)
        mean = torch.where(valid, truth, 0.0).sum(dim=(-2, -1), keepdim=True) / count
    return mean.expand_as(truth).contiguous()


def mean_dolp(sequences: Iterable[Float[Tensor, "*pixels"]]) -> float:
    """Mean over all pixels of all sequences; ValueError if there are none."""
    total, count = 0.0, 0
    for frames in sequences:
        total, count = total + frames.double().sum().item(), count + frames.numel()
    if count == 0:
        raise ValueError("the mean DoLP needs at least one frame, got none: is the training split empty?")
    return total / count
