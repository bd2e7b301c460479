"""Reference rows: constants, which see no events, and the oracle mean, which sees the truth. None is a method."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.metrics.similarity import mean_where
from polarnet.stokes import Prediction

Frames = Float[Tensor, "n h w"]
Valid = Bool[Tensor, "n h w"] | None
"""Pixels that count; None: all."""


@dataclass(frozen=True)
class Reference:
    """A row of the tables beside the methods, with constant DoLP over a frame."""

    name: str
    label: str
    about: str
    """Glossary sentence of the HTML pages."""
    predict: Callable[[Frames, Valid, float | None], Prediction]
    """True DoLP, valid pixels and mean DoLP of the training split -> a frame for each true frame."""
    needs_train_mean: bool = False
    colour: str = "#98a2b3"


def zeros(truth: Frames, valid: Valid, train_mean: float | None) -> Prediction:
    """DoLP of 0 everywhere."""
    return Prediction(torch.zeros_like(truth))


def constant(truth: Frames, valid: Valid, train_mean: float | None) -> Prediction:
    """The mean DoLP of the training split everywhere; ValueError if it is unknown."""
    if train_mean is None:
        raise ValueError("row train_mean needs the mean DoLP of a training split, got none; run `dvc repro synthesize`")
    return Prediction(torch.full_like(truth, train_mean))


def oracle_mean(truth: Frames, valid: Valid = None, train_mean: float | None = None) -> Prediction:
    """Mean over the valid pixels of each frame, the constant with the smallest squared error; 0 if there are none."""
    mean = mean_where(truth, valid).nan_to_num(0.0)
    return Prediction(mean[..., None, None].expand_as(truth).contiguous())


REFERENCES = {
    row.name: row
    for row in (
        Reference("zeros", "zeros", "A constant: no polarization anywhere.", zeros),
        Reference("train_mean", "training mean", "A constant: the mean DoLP of the training split.", constant, True),
        Reference(
            "oracle_mean",
            "oracle mean",
            "Each true frame's own mean. It looks at the truth, so it is no method; what does not beat it shows little "
            "spatial skill in MSE.",
            oracle_mean,
        ),
    )
}
"""Reference by name, in the order of all tables."""
