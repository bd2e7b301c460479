"""Reliability curve: the squared error that a network expects, against the measured one."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

LOWEST, HIGHEST, BINS = -12.0, 0.0, 24  # bins of the log variance; values outside fall into the outermost bins


@dataclass(frozen=True)
class Reliability:
    """Sums over the pixels of each bin of predicted log variance; add instances to join sequences."""

    pixels: Float[Tensor, " bins"]
    predicted: Float[Tensor, " bins"]
    """Sum of the predicted variances."""
    measured: Float[Tensor, " bins"]
    """Sum of the squared errors of DoLP."""

    def __add__(self, other: "Reliability") -> "Reliability":
        return Reliability(self.pixels + other.pixels, self.predicted + other.predicted, self.measured + other.measured)

    def curve(self) -> list[tuple[float, float, int]]:
        """Mean predicted variance, mean squared error and number of pixels of each non-empty bin."""
        rows = zip(self.predicted.tolist(), self.measured.tolist(), self.pixels.tolist(), strict=True)
        return [(predicted / count, measured / count, round(count)) for predicted, measured, count in rows if count]

    def log_error(self) -> float:
        """Mean over pixels of |ln(mean squared error / mean predicted variance)| in their bin; 0 if calibrated.

        ValueError if no pixel has an error.
        """
        here = (self.pixels > 0) & (self.measured > 0)
        if not here.any():
            raise ValueError("a reliability curve needs pixels with an error, got none")
        ratio = (self.measured[here] / self.predicted[here]).log().abs()
        return float((ratio * self.pixels[here]).sum() / self.pixels[here].sum())


def reliability(
    log_variance: Float[Tensor, "n h w"],
    dolp: Float[Tensor, "n h w"],
    truth: Float[Tensor, "n h w"],
    valid: Bool[Tensor, "n h w"] | None = None,
) -> Reliability:
    """Reliability of the predicted `log_variance` of DoLP in [0, 1], over the `valid` pixels of n frames."""
    everywhere = torch.ones_like(truth, dtype=torch.bool) if valid is None else valid
    predicted, squared = log_variance[everywhere].double(), (dolp - truth)[everywhere].double().square()
    width = (HIGHEST - LOWEST) / BINS
    bins = ((predicted - LOWEST) / width).floor().long().clamp(0, BINS - 1)
    sums = (
        torch.zeros(BINS, dtype=torch.float64).index_add(0, bins.cpu(), values.cpu())
        for values in (torch.ones_like(squared), predicted.exp(), squared)
    )
    return Reliability(*sums)
