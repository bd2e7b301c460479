"""Offset of a recovered frame: the constants of atanh(s1) and atanh(s2), which changes of light do not show.

Behind opposite polarizers, atanh(s1) is half the difference of the logarithms of I0 and I90, and atanh(s2) that of I45
and I135. Events are changes of these logarithms, so that a constant of each is left to other cues.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.metrics.similarity import mse
from polarnet.stokes import Prediction

MAX_DOLP = 0.98  # beyond it, atanh grows without bound: a pixel of DoLP 1 would outweigh all others


def contrasts(dolp: Float[Tensor, "*b h w"], aolp: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b 2 h w"]:
    """atanh(s1) and atanh(s2) from DoLP, reduced by the factor `MAX_DOLP`, and AoLP in radians."""
    direction = torch.stack([torch.cos(2 * aolp), torch.sin(2 * aolp)], dim=-3)
    return torch.atanh(MAX_DOLP * dolp[..., None, :, :] * direction)


def dolp_of(contrasts: Float[Tensor, "*b 2 h w"]) -> Float[Tensor, "*b h w"]:
    """DoLP in [0, 1] from atanh(s1) and atanh(s2); undoes `contrasts`."""
    s1, s2 = torch.tanh(contrasts).unbind(-3)
    return (torch.hypot(s1, s2) / MAX_DOLP).clamp(max=1)


def frame_offset(
    predicted: Float[Tensor, "n 2 h w"], truth: Float[Tensor, "n 2 h w"], valid: Bool[Tensor, "n h w"] | None = None
) -> Float[Tensor, "n 2"]:
    """Median over a frame's valid pixels of what `predicted` lacks of the true atanh(s1) and atanh(s2)."""
    lacking = truth - predicted
    if valid is not None:
        lacking = torch.where(valid[:, None], lacking, torch.nan)
    return lacking.flatten(-2).nanmedian(dim=-1).values


def offset_scores(
    prediction: Prediction,
    dolp: Float[Tensor, "n h w"],
    aolp: Float[Tensor, "n h w"],
    valid: Bool[Tensor, "n h w"] | None = None,
) -> dict[str, Float[Tensor, " n"]]:
    """`offset`, the mean square of a frame's two offsets, and `no_offset_mse`, the MSE of DoLP without them.

    A method without AoLP has neither.
    """
    if prediction.aolp is None:
        return {}
    own, truth = (contrasts(*maps) for maps in ((prediction.dolp.clamp(0, 1), prediction.aolp), (dolp, aolp)))
    offset = frame_offset(own, truth, valid)
    moved = dolp_of(own + offset[..., None, None])
    return {"offset": offset.square().mean(1), "no_offset_mse": mse(moved, dolp, valid)}
