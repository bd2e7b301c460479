"""What a prediction is held against its truth by (paper Eq. 6-9)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.ranges import allowed, check_ranges
from polarnet.similarity import Lpips, mean_where, mse, ssim, with_truth_outside

Frames = Float[Tensor, "t b h w"]
Valid = Bool[Tensor, "t b h w"] | None

LOG_VARIANCES = (-10.0, 1.0)  # of DoLP: what an error can be


@dataclass(frozen=True)
class LossConfig:
    """Section `loss` of params.yaml: the weights of Eq. 9; the paper has 1, 1, 10. A weight of 0 leaves a term out.

    The last two are for networks that predict more than DoLP, and are left out for others.
    """

    mse: float = field(metadata=allowed(low=0))
    ssim: float = field(metadata=allowed(low=0))
    lpips: float = field(metadata=allowed(low=0))
    stokes: float = field(metadata=allowed(low=0))
    """Of the squared error of (S1, S2) / S0."""
    uncertainty: float = field(metadata=allowed(low=0))
    """Of the negative logarithm of the likelihood of DoLP's error under its predicted variance, which alone learns
    from it."""

    def __post_init__(self):
        check_ranges(self)
        if self.mse == self.ssim == self.lpips == 0:
            raise ValueError("mse, ssim, lpips: expected at least one weight > 0, got 0 for all three")


def known_frames(predicted: Frames, truth: Frames, valid: Valid) -> tuple[Tensor, Tensor, Tensor | None]:
    """(predicted, truth, valid) as n frames, without those of which nothing is known."""
    a, b = predicted.flatten(0, 1), truth.flatten(0, 1)
    if valid is None:
        return a, b, None
    frames = valid.flatten(0, 1)
    known = frames.any(-1).any(-1)
    return a[known], b[known], frames[known]


class FrameLoss:
    """A weighted sum of terms, each a mean over all frames: mse, mae, ssim_loss (1 - SSIM, Eq. 7) and lpips.

    Pixels that are not valid count in no term, as `polarnet.similarity` says, nor do frames without a valid pixel.
    ValueError where LPIPS has a weight but `lpips` is None.
    """

    def __init__(self, weights: Mapping[str, float], lpips: Lpips | None):
        if lpips is None and weights.get("lpips", 0) > 0:
            raise ValueError(f"lpips: its weight is {weights['lpips']}, but there is no LPIPS network; load one")
        known: dict[str, Callable[[Tensor, Tensor, Tensor | None], Tensor]] = {
            "mse": mse,
            "mae": lambda a, b, valid: (a - b).abs() if valid is None else mean_where((a - b).abs(), valid),
            "ssim_loss": lambda a, b, valid: 1 - ssim(a, b, valid),
        }
        if lpips is not None:
            known["lpips"] = lambda a, b, valid: lpips(with_truth_outside(a, b, valid), b)
        self.weights = {name: weight for name, weight in weights.items() if weight}
        self._terms = {name: known[name] for name in self.weights}

    def __call__(self, predicted: Frames, truth: Frames, valid: Valid = None) -> dict[str, Float[Tensor, ""]]:
        """The terms by name, without their weights; 0 where nothing is known of any frame."""
        a, b, known = known_frames(predicted, truth, valid)
        if not len(a):
            return {name: 0 * predicted.sum() for name in self._terms}
        return {name: term(a, b, known).mean() for name, term in self._terms.items()}

    def total(self, terms: Mapping[str, Float[Tensor, ""]]) -> Float[Tensor, ""]:
        """The weighted sum of terms."""
        return torch.stack([self.weights[name] * term for name, term in terms.items()]).sum()


class PolarizationLoss(FrameLoss):
    """A `FrameLoss` of DoLP; where a network says more, also of (s1, s2) and of its uncertainty."""

    def __init__(self, config: LossConfig, lpips: Lpips | None, *, dolp_only: bool):
        super().__init__({"mse": config.mse, "ssim_loss": config.ssim, "lpips": config.lpips}, lpips)
        more = {} if dolp_only else {"stokes": config.stokes, "uncertainty": config.uncertainty}
        self._more = {name: weight for name, weight in more.items() if weight}
        self.weights |= self._more

    def __call__(
        self, predicted: Float[Tensor, "t b k h w"], truth: Float[Tensor, "t b m h w"], valid: Valid = None
    ) -> dict[str, Float[Tensor, ""]]:
        """The terms by name, without their weights. Maps of both: DoLP, s1, s2; and predicted, the log variance."""
        terms = super().__call__(predicted[:, :, 0], truth[:, :, 0], valid)
        everywhere = truth[:, :, 0].new_ones(truth[:, :, 0].shape, dtype=torch.bool) if valid is None else valid
        if "stokes" in self._more:
            errors = (predicted[:, :, 1:3] - truth[:, :, 1:]).square().sum(2)
            terms["stokes"] = errors[everywhere].mean() if everywhere.any() else 0 * errors.sum()
        if "uncertainty" in self._more:
            log_variance = predicted[:, :, 3].clamp(*LOG_VARIANCES)
            squared = (predicted[:, :, 0].detach().clamp(0, 1) - truth[:, :, 0]).square()
            nll = (squared * torch.exp(-log_variance) + log_variance) / 2
            terms["uncertainty"] = nll[everywhere].mean() if everywhere.any() else 0 * nll.sum()
        return terms
