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
Maps = Float[Tensor, "t b *k h w"]
TrueMaps = Float[Tensor, "t b *m h w"]  # may be more: `predicted` may be DoLP alone
Valid = Bool[Tensor, "t b h w"] | None
Terms = tuple[Mapping[str, float], Callable[[Maps, TrueMaps, Valid], Mapping[str, Tensor]]]
"""Weights of some terms by name, and the function that computes those terms together."""


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


class Loss:
    """A weighted sum of terms by name, without those of weight 0."""

    def __init__(self, *groups: Terms):
        self.weights = {name: weight for weights, _ in groups for name, weight in weights.items() if weight}
        self._values = [values for weights, values in groups if any(weights.values())]

    def __call__(self, predicted: Maps, truth: TrueMaps, valid: Valid = None) -> dict[str, Float[Tensor, ""]]:
        """Return the terms by name, before their weights; all are 0 if no frame has a valid pixel."""
        return {name: term for values in self._values for name, term in values(predicted, truth, valid).items()}

    def total(self, terms: Mapping[str, Float[Tensor, ""]]) -> Float[Tensor, ""]:
        """Return the weighted sum of the terms."""
        return torch.stack([self.weights[name] * term for name, term in terms.items()]).sum()


def frame_terms(weights: Mapping[str, float], lpips: Lpips | None, index: int | None = None, prefix: str = "") -> Terms:
    """Terms mse, mae, ssim_loss (1 - SSIM, Eq. 7) and lpips of the map `index`, each a mean over all frames.

    `index` is None for frames without an axis of maps; `prefix` begins the names. Invalid pixels (see
    `polarnet.metrics.similarity`) and frames without a valid pixel count in no term. ValueError if LPIPS has a weight
    but `lpips` is None.
    """
    if lpips is None and weights.get("lpips", 0) > 0:
        raise ValueError(f"lpips: its weight is {weights['lpips']}, but there is no LPIPS network; load one")
    scores: dict[str, Callable[[Tensor, Tensor, Tensor | None], Tensor]] = {
        "mse": mse,
        "mae": lambda a, b, valid: (a - b).abs() if valid is None else mean_where((a - b).abs(), valid),
        "ssim_loss": lambda a, b, valid: 1 - ssim(a, b, valid),
    }
    if lpips is not None:
        scores["lpips"] = lambda a, b, valid: lpips(with_truth_outside(a, b, valid), b)
    used = [name for name, weight in weights.items() if weight]

    def values(predicted: Maps, truth: TrueMaps, valid: Valid) -> dict[str, Tensor]:
        frames = (predicted, truth) if index is None else (predicted[:, :, index], truth[:, :, index])
        a, b, known = known_frames(*frames, valid)
        return {prefix + name: scores[name](a, b, known).mean() if len(a) else 0 * predicted.sum() for name in used}

    return {prefix + name: weights[name] for name in used}, values


def polarization_loss(config: LossConfig, lpips: Lpips | None, *, dolp_only: bool) -> Loss:
    """Loss of the maps DoLP, s1 and s2, or of predictions of DoLP alone.

    With `config.half_weight`, the terms `mse` and `stokes` are replaced by `relative_mse` and `relative_stokes`.
    """

    def squared_errors(name: str, weight: float, maps: slice) -> Terms:
        def values(predicted: Maps, truth: TrueMaps, valid: Valid) -> dict[str, Tensor]:
            errors = (predicted[:, :, maps] - truth[:, :, maps]).square().sum(2)
            errors = errors * frame_weights(truth[:, :, 0], valid, config.half_weight)[..., None, None]
            if valid is None:
                return {name: errors.flatten().mean()}
            return {name: errors[valid].mean() if valid.any() else 0 * errors.sum()}

        return {name: weight}, values

    similarity, stokes = {"ssim_loss": config.ssim, "lpips": config.lpips}, 0.0 if dolp_only else config.stokes
    if config.half_weight is None:
        frames = frame_terms({"mse": config.mse} | similarity, lpips, index=0)
        return Loss(frames, squared_errors("stokes", stokes, slice(1, None)))
    return Loss(
        squared_errors("relative_mse", config.mse, slice(0, 1)),
        frame_terms(similarity, lpips, index=0),
        squared_errors("relative_stokes", stokes, slice(1, None)),
    )


def frame_weights(dolp: Frames, valid: Valid, half_weight: float | None) -> Float[Tensor, "t b"]:
    """Weight of each frame: 1 if it is unpolarized, and less the higher its mean squared DoLP; None: 1 for all."""
    if half_weight is None:
        return torch.ones_like(dolp[..., 0, 0])
    level = mean_where(dolp.square(), valid).nan_to_num(0.0)  # NaN: no valid pixel
    return half_weight / (half_weight + level)
