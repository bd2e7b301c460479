"""Training losses (paper Eq. 6-9)."""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Bool, Float
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from polarnet.metrics.lpips import Lpips
from polarnet.metrics.similarity import mean_where, mse, ssim, with_truth_outside
from polarnet.runtime.sections import section

Frames = Float[Tensor, "t b h w"]
Valid = Bool[Tensor, "t b h w"] | None


@section
class LossConfig:
    """Section `loss` of params.yaml: weights of the loss terms (Eq. 9). A weight of 0 leaves a term out.

    The paper uses 1, 1, 10 for the first three. `stokes` applies only to networks that predict more than DoLP.
    """

    mse: NonNegativeFloat
    ssim: NonNegativeFloat
    lpips: NonNegativeFloat
    stokes: NonNegativeFloat
    """Weight of the squared error of (S1, S2) / S0."""
    half_weight: PositiveFloat | None
    """Mean squared DoLP of a frame whose squared errors count half in `mse` and `stokes`; those of unpolarized frames
    count fully, and those of strongly polarized frames less. None: all frames count alike."""

    def __post_init__(self):
        if self.mse == self.ssim == self.lpips == 0:
            raise ValueError("mse, ssim, lpips: expected at least one weight > 0, got 0 for all three")


def known_frames(predicted: Frames, truth: Frames, valid: Valid) -> tuple[Tensor, Tensor, Tensor | None]:
    """Flatten (predicted, truth, valid) to n frames and drop frames without a valid pixel."""
    a, b = predicted.flatten(0, 1), truth.flatten(0, 1)
    if valid is None:
        return a, b, None
    frames = valid.flatten(0, 1)
    known = frames.any(-1).any(-1)
    return a[known], b[known], frames[known]


class FrameLoss:
    """A weighted sum of mse, mae, ssim_loss (1 - SSIM, Eq. 7) and lpips, each a mean over all frames.

    Invalid pixels (see `polarnet.metrics.similarity`) and frames without a valid pixel count in no term.
    ValueError if LPIPS has a weight but `lpips` is None.
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
        self._terms = {name: known[name] for name in self.weights if name in known}

    def __call__(self, predicted: Frames, truth: Frames, valid: Valid = None) -> dict[str, Float[Tensor, ""]]:
        """Return the terms by name, before their weights; all are 0 if no frame has a valid pixel."""
        a, b, known = known_frames(predicted, truth, valid)
        if not len(a):
            return {name: 0 * predicted.sum() for name in self._terms}
        return {name: term(a, b, known).mean() for name, term in self._terms.items()}

    def total(self, terms: Mapping[str, Float[Tensor, ""]]) -> Float[Tensor, ""]:
        """Return the weighted sum of the terms."""
        return torch.stack([self.weights[name] * term for name, term in terms.items()]).sum()


class PolarizationLoss(FrameLoss):
    """A `FrameLoss` of DoLP, plus a term for (s1, s2) if the network predicts them.

    With `config.half_weight`, the terms `mse` and `stokes` are replaced by `relative_mse` and `relative_stokes`.
    """

    def __init__(self, config: LossConfig, lpips: Lpips | None, *, dolp_only: bool):
        self._half_weight, prefix = config.half_weight, "" if config.half_weight is None else "relative_"
        weights = {f"{prefix}mse": config.mse, "ssim_loss": config.ssim, "lpips": config.lpips}
        super().__init__(weights | ({} if dolp_only else {f"{prefix}stokes": config.stokes}), lpips)

    def __call__(
        self, predicted: Float[Tensor, "t b k h w"], truth: Float[Tensor, "t b m h w"], valid: Valid = None
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the unweighted terms by name, in the order of `weights`.

        The maps are DoLP, s1 and s2; `predicted` may be DoLP alone.
        """
        terms = super().__call__(predicted[:, :, 0], truth[:, :, 0], valid)
        for name in [name for name in self.weights if name not in terms]:
            maps = slice(0, 1) if name == "relative_mse" else slice(1, None)
            errors = (predicted[:, :, maps] - truth[:, :, maps]).square().sum(2)
            terms[name] = _mean_of_known(errors * self._weight_of(truth[:, :, 0], valid)[..., None, None], valid)
        return {name: terms[name] for name in self.weights}

    def _weight_of(self, dolp: Frames, valid: Valid) -> Float[Tensor, "t b"]:
        """Weight of each frame: 1 if it is unpolarized, and less the higher its mean squared DoLP."""
        if self._half_weight is None:
            return torch.ones_like(dolp[..., 0, 0])
        level = mean_where(dolp.square(), valid).nan_to_num(0.0)  # NaN: no valid pixel
        return self._half_weight / (self._half_weight + level)


def _mean_of_known(of_pixels: Frames, valid: Valid) -> Float[Tensor, ""]:
    """Mean over the valid pixels; 0 if there is none."""
    if valid is None:
        return of_pixels.flatten().mean()
    return of_pixels[valid].mean() if valid.any() else 0 * of_pixels.sum()
