"""Offset of a recovered frame: the constants of atanh(s1) and atanh(s2), which changes of light do not show.

Behind opposite polarizers, atanh(s1) is half the difference of the logarithms of I0 and I90, and atanh(s2) that of I45
and I135. Events are changes of these logarithms, so that a constant of each is left to other cues.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.metrics.similarity import mse
from polarnet.stokes import Prediction, stokes_from_polarization

MAX_DOLP = 0.98  # beyond it, atanh grows without bound: a pixel of DoLP 1 would outweigh all others


def atanh_stokes(dolp: Float[Tensor, "*b h w"], aolp: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b 2 h w"]:
    """atanh(s1) and atanh(s2) from DoLP, reduced by the factor `MAX_DOLP`, and AoLP in radians."""
    vectors = stokes_from_polarization(torch.ones_like(dolp), MAX_DOLP * dolp, aolp)
    return torch.atanh(vectors[..., 1:, :, :])


def dolp_of(atanh: Float[Tensor, "*b 2 h w"]) -> Float[Tensor, "*b h w"]:
    """DoLP in [0, 1] from atanh(s1) and atanh(s2); undoes `atanh_stokes`."""
    s1, s2 = torch.tanh(atanh).unbind(-3)
    return (torch.hypot(s1, s2) / MAX_DOLP).clamp(max=1)


def offset_scores(
    prediction: Prediction,
    dolp: Float[Tensor, "n h w"],
    aolp: Float[Tensor, "n h w"],
    valid: Bool[Tensor, "n h w"] | None = None,
) -> dict[str, Float[Tensor, " n"]]:
    """`offset` and `no_offset_mse` of each frame; a method without AoLP has neither.

    The offsets of a frame are the medians, over its valid pixels, of what the prediction lacks of the true atanh(s1)
    and atanh(s2). `offset` is their mean square, `no_offset_mse` the MSE of DoLP once they are added.
    """
    if prediction.aolp is None:
        return {}
    own, truth = (atanh_stokes(*maps) for maps in ((prediction.dolp.clamp(0, 1), prediction.aolp), (dolp, aolp)))
    lacking = truth - own
    if valid is not None:
        lacking = torch.where(valid[:, None], lacking, torch.nan)
    offset = lacking.flatten(-2).nanmedian(dim=-1).values
    moved = dolp_of(own + offset[..., None, None])
    return {"offset": offset.square().mean(1), "no_offset_mse": mse(moved, dolp, valid)}
