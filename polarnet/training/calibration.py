"""Expected-error fit: a map from features to the log-variance of DoLP's error, fitted after training.

During training the variance head learns little beyond the average error, because the errors keep changing. After
training the errors are fixed. The log of the expected squared error is then a linear function of the features, fitted
by maximum likelihood under normal errors, which is a convex problem.

There are many pixels but few scenes, so a ridge penalty guards against overfitting. Cross-validation over left-out
scenes selects the ridge. If the features do not help on left-out scenes, the fit expects the same error everywhere.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

RIDGES = (0.01, 0.1, 1.0, 10.0, 100.0)  # penalties on coefficients of unit-variance features; the largest removes them
FOLDS = 5
MIN_SPREAD = 1e-6  # features with a smaller standard deviation are ignored
TOLERANCE = 1e-9  # L-BFGS-B stops at this relative change of the mean log-likelihood, or at this gradient


class Scene(NamedTuple):
    """Features and squared errors of some pixels of one scene."""

    features: Float[Tensor, "n c"]
    squared: Float[Tensor, " n"]
    """Squared errors."""


class ExpectedErrors(NamedTuple):
    """Fitted map: log-variance = weight @ features + bias."""

    weight: Float[Tensor, " c"]
    bias: float
    ridge: float

    def loss(self, scene: Scene) -> float:
        """Return twice the negative log-likelihood of the errors, up to a constant, as a mean over pixels."""
        expected = scene.features @ self.weight + self.bias
        return float((scene.squared * torch.exp(-expected) + expected).mean())


def fitted(scenes: Sequence[Scene]) -> ExpectedErrors:
    """Fit the expected errors by maximum likelihood, with the ridge that does best on left-out scenes.

    ValueError if all errors are 0.
    """
    if not any(scene.squared.any() for scene in scenes):
        pixels = sum(len(scene.squared) for scene in scenes)
        raise ValueError(f"a fit of expected errors needs pixels with errors, got {pixels} pixels without any")
    losses = dict.fromkeys(RIDGES, 0.0)
    for fold in range(min(FOLDS, len(scenes))):
        others = [scene for k, scene in enumerate(scenes) if k % FOLDS != fold]
        if not any(scene.squared.any() for scene in others):
            continue
        for ridge in RIDGES:
            fit = _fitted(others, ridge)
            losses[ridge] += sum(fit.loss(scene) for scene in scenes[fold::FOLDS])
    return _fitted(scenes, min(reversed(RIDGES), key=losses.__getitem__))


def _fitted(scenes: Sequence[Scene], ridge: float) -> ExpectedErrors:
    from scipy.optimize import minimize  # half a second, which every stage would pay

    features, squared = (torch.cat(field).numpy() for field in zip(*scenes, strict=True))
    mean, spread = features.mean(0), features.std(0)
    scale = np.where(spread > MIN_SPREAD, 1 / spread.clip(MIN_SPREAD), 0)
    scaled = ((features - mean) * scale).astype(np.float64)  # once, instead of in every step

    def loss_and_slope(w: Float64[np.ndarray, " k"]) -> tuple[float, Float64[np.ndarray, " k"]]:
        expected = scaled @ w[:-1] + w[-1]
        relative = squared * np.exp(-expected)
        too_much = 1 - relative
        slope = np.append(too_much @ scaled / len(scaled) + 2 * ridge * w[:-1], too_much.mean())
        return (relative + expected).mean() + ridge * np.square(w[:-1]).sum(), slope

    start = np.append(np.zeros_like(mean), np.log(squared.mean()))
    *coefficients, level = minimize(loss_and_slope, start, jac=True, method="L-BFGS-B", tol=TOLERANCE).x
    weight = coefficients * scale
    return ExpectedErrors(torch.from_numpy(weight), float(level - weight @ mean), ridge)
