"""What a prediction is held against its truth by (paper Eq. 6-9)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.ranges import allowed, check_ranges
from polarnet.similarity import Lpips, mse, ssim

Frames = Float[Tensor, "t b h w"]


@dataclass(frozen=True)
class LossConfig:
    """Section `loss` of params.yaml: the weights of Eq. 9; the paper has 1, 1, 10. A weight of 0 leaves a term out."""

    mse: float = field(metadata=allowed(low=0))
    ssim: float = field(metadata=allowed(low=0))
    lpips: float = field(metadata=allowed(low=0))

    def __post_init__(self):
        check_ranges(self)
        if self.mse == self.ssim == self.lpips == 0:
            raise ValueError("mse, ssim, lpips: expected at least one weight > 0, got 0 for all three")


class FrameLoss:
    """A weighted sum of terms, each a mean over all frames: mse, mae, ssim_loss (1 - SSIM, Eq. 7) and lpips.

    Without an LPIPS network its term is left out of `weights`, and so of the sum.
    """

    def __init__(self, weights: Mapping[str, float], lpips: Lpips | None):
        known: dict[str, Callable[[Tensor, Tensor], Tensor] | None] = {
            "mse": mse,
            "mae": lambda a, b: (a - b).abs(),
            "ssim_loss": lambda a, b: 1 - ssim(a, b),
            "lpips": lpips,
        }
        self.weights = {name: weight for name, weight in weights.items() if weight and known[name] is not None}
        self._terms = {name: term for name in self.weights if (term := known[name]) is not None}

    def __call__(self, predicted: Frames, truth: Frames) -> dict[str, Float[Tensor, ""]]:
        """The terms by name, without their weights."""
        a, b = predicted.flatten(0, 1), truth.flatten(0, 1)
        return {name: term(a, b).mean() for name, term in self._terms.items()}

    def total(self, terms: Mapping[str, Float[Tensor, ""]]) -> Float[Tensor, ""]:
        """The weighted sum of terms."""
        return torch.stack([self.weights[name] * term for name, term in terms.items()]).sum()


def polarization_loss(config: LossConfig, lpips: Lpips | None) -> FrameLoss:
    """The paper's loss, Eq. 9 of Eq. 6, 7 and 8, as a mean over frames where the paper sums."""
    return FrameLoss({"mse": config.mse, "ssim_loss": config.ssim, "lpips": config.lpips}, lpips)
