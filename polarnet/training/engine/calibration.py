"""Expected-error fit: a map from features to the log-variance of DoLP's error, fitted after training.

The log of the expected squared error is a linear function of the features, fitted by maximum likelihood under normal
errors, which is a convex problem. There are many pixels but few scenes, so cross-validation over left-out scenes
selects a ridge penalty. If the features do not help there, the fit expects the same error everywhere.
"""

import statistics
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

RIDGES = (0.01, 0.1, 1.0, 10.0, 100.0)  # penalties on coefficients of unit-variance features; the largest removes them
FOLDS = 5
MIN_SPREAD = 1e-6  # features with a smaller standard deviation are ignored
LOWEST_DOLP = 1e-3  # scenes with a lower mean DoLP count as this one in `weights_for`
TOLERANCE = 1e-9  # L-BFGS-B stops at this relative change of the mean log-likelihood, or at this gradient


class Scene(NamedTuple):
    """Features and squared errors of some pixels of one picture and its variants."""

    features: Float[Tensor, "n c"]
    squared: Float[Tensor, " n"]
    weights: Float[Tensor, " n"]
    """Weights of the pixels in the fit; only their ratios matter."""


def joined(scenes: Sequence[Scene]) -> Scene:
    """All pixels of these scenes as one scene."""
    return Scene(*(torch.cat(field) for field in zip(*scenes, strict=True)))


class ExpectedErrors(NamedTuple):
    """Fitted map: log-variance = weight @ features + bias."""

    weight: Float[Tensor, " c"]
    bias: float
    ridge: float

    def loss(self, scene: Scene) -> float:
        """Return twice the negative log-likelihood of the errors, up to a constant, times the weights, over pixels."""
        expected = scene.features @ self.weight + self.bias
        return float((scene.weights * (scene.squared * torch.exp(-expected) + expected)).mean())


def weights_for(dolp: Sequence[float], median: float, ninetieth: float) -> list[float]:
    """Weights of sequences, with these mean DoLPs, for scenes whose mean DoLP is log-normal; errors grow with DoLP.

    `median` and `ninetieth` are the distribution's median and 90th percentile. The range of DoLP is cut halfway between
    neighbouring values, on a logarithmic scale. A sequence weighs as much as the distribution has in its part. The sum
    is the number of sequences.
    """
    values = np.log(np.maximum(dolp, LOWEST_DOLP))
    order = np.argsort(values, kind="stable")
    spread = np.log(ninetieth / median) / statistics.NormalDist().inv_cdf(0.9)
    scenes = statistics.NormalDist(np.log(median), spread)
    cuts = (values[order][1:] + values[order][:-1]) / 2
    below = [0.0, *map(scenes.cdf, cuts), 1.0]
    weights = np.empty(len(values))
    weights[order] = len(values) * np.diff(below)
    return weights.tolist()


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
        if not any((scene.weights * scene.squared).any() for scene in others):
            continue
        for ridge in RIDGES:
            fit = _fitted(others, ridge)
            losses[ridge] += sum(fit.loss(scene) for scene in scenes[fold::FOLDS])
    return _fitted(scenes, min(reversed(RIDGES), key=losses.__getitem__))


def _fitted(scenes: Sequence[Scene], ridge: float) -> ExpectedErrors:
    from scipy.optimize import minimize  # half a second, which every stage would pay

    features, squared, weights = (field.numpy() for field in joined(scenes))
    weights = weights / weights.mean()
    mean = (weights[:, None] * features).mean(0)
    spread = np.sqrt((weights[:, None] * np.square(features - mean)).mean(0))
    scale = np.where(spread > MIN_SPREAD, 1 / spread.clip(MIN_SPREAD), 0)
    scaled = ((features - mean) * scale).astype(np.float64)  # once, instead of in every step

    def loss_and_slope(w: Float64[np.ndarray, " k"]) -> tuple[float, Float64[np.ndarray, " k"]]:
        expected = scaled @ w[:-1] + w[-1]
        relative = squared * np.exp(-expected)
        too_much = weights * (1 - relative)
        slope = np.append(too_much @ scaled / len(scaled) + 2 * ridge * w[:-1], too_much.mean())
        return (weights * (relative + expected)).mean() + ridge * np.square(w[:-1]).sum(), slope

    start = np.append(np.zeros_like(mean), np.log((weights * squared).mean()))
    *coefficients, level = minimize(loss_and_slope, start, jac=True, method="L-BFGS-B", tol=TOLERANCE).x
    weight = coefficients * scale
    return ExpectedErrors(torch.from_numpy(weight), float(level - weight @ mean), ridge)
