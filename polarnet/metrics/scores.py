"""Scores of predicted frames against the truth, without LPIPS, which needs weights."""

from collections.abc import Mapping

from jaxtyping import Bool, Float
from torch import Tensor

from polarnet.metrics.similarity import aolp_error_deg, correlation, mse, psnr, ssim
from polarnet.stokes import Prediction


def frame_scores(
    prediction: Prediction,
    dolp: Float[Tensor, "n h w"],
    aolp: Float[Tensor, "n h w"],
    valid: Bool[Tensor, "n h w"] | None = None,
) -> Mapping[str, Float[Tensor, " n"]]:
    """Scores of each frame as in the benchmark: mse, psnr, ssim, corr and, if an angle is predicted, aolp_deg.

    >>> import torch
    >>> from polarnet.metrics import frame_scores
    >>> from polarnet.stokes import Prediction
    >>> truth = torch.full((2, 16, 16), 0.5)
    >>> frame_scores(Prediction(truth), truth, truth)["mse"]
    tensor([0., 0.])
    """
    scores = {
        "mse": mse(prediction.dolp, dolp, valid),
        "psnr": psnr(prediction.dolp, dolp, valid),
        "ssim": ssim(prediction.dolp, dolp, valid),
        "corr": correlation(prediction.dolp, dolp, valid),
    }
    if prediction.aolp is not None:
        scores["aolp_deg"] = aolp_error_deg(prediction.aolp, aolp, dolp, valid)
    return scores


def score(
    prediction: Prediction,
    dolp: Float[Tensor, "n h w"],
    aolp: Float[Tensor, "n h w"],
    warmup_frames: int = 0,
    valid: Bool[Tensor, "n h w"] | None = None,
) -> dict[str, float]:
    """Means of `frame_scores` over the frames after the first `warmup_frames`; ValueError if none is left.

    >>> import torch
    >>> from polarnet.metrics import score
    >>> from polarnet.stokes import Prediction
    >>> truth = torch.full((3, 16, 16), 0.5)
    >>> score(Prediction(truth + 0.1), truth, truth)["mse"]
    0.010...
    """
    if not 0 <= warmup_frames < len(dolp):
        raise ValueError(f"warmup_frames: expected 0 to {len(dolp) - 1}, got {warmup_frames}")
    scores = frame_scores(prediction, dolp, aolp, valid)
    return {name: float(values[warmup_frames:].mean()) for name, values in scores.items()}
