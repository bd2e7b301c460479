"""Expected errors brought to the size that errors have on pictures that a network has not learnt from.

What a network expects of its own errors it learns on pictures whose errors it makes small at the same time, and slowly:
it tells where errors are large better than how large. So log variances get a slope and an offset once the training is
over, those of greatest likelihood on the validation split (as temperatures of classifiers do: Guo et al., ICML 2017).
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

ROUNDS = 50  # of Newton's method, which is there after a few


class Calibration(NamedTuple):
    """An expected log variance v becomes offset + slope * v."""

    offset: float
    slope: float


def fitted(log_variance: Float[Tensor, " n"], squared: Float[Tensor, " n"]) -> Calibration:
    """Under which the squared errors are likeliest, of normal distributions; slope 1 where all log variances are alike.

    ValueError where there is no error at all.
    """
    if not squared.sum() > 0:
        raise ValueError(f"expected errors can be fitted to errors alone, got {len(squared)} pixels without any")
    mean, spread = log_variance.mean(), log_variance.std(correction=0)
    level = squared.mean().log()
    if not spread > 1e-6:
        return Calibration(float(level - mean), 1.0)
    x = torch.stack([torch.ones_like(log_variance), (log_variance - mean) / spread])
    w = torch.stack([level, torch.zeros_like(level)])

    def likelihood(w: Tensor) -> Tensor:  # negative logarithm, but for constants
        return (squared * torch.exp(-(w @ x)) + w @ x).mean()

    for _ in range(ROUNDS):
        relative = squared * torch.exp(-(w @ x))
        slope = (x * (1 - relative)).mean(1)
        bend = (x * relative) @ x.T / x.shape[1]
        step = torch.linalg.solve(bend, slope)
        while likelihood(w - step) > likelihood(w):
            step = step / 2
        w = w - step
        if step.abs().max() < 1e-9:
            break
    steepness = w[1] / spread
    return Calibration(float(w[0] - steepness * mean), float(steepness))
