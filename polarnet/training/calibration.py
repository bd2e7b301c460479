"""Expected errors: once a network is trained, how large they are is fitted to what may tell it.

While a network learns, its errors change, and a likelihood of them teaches it little more than how large they are on
the whole. When the training is over they stay as they are. Then the logarithm of the expected squared error, as a
linear function of what may tell it (features), is the likeliest one of normal distributions: a convex problem. Pixels
are many and scenes are few: what tells a scene's errors from another's is believed as far as it does so for scenes that
were left out of the fit, and where it does not, errors are expected to be the same everywhere.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.optimize import minimize
from torch import Tensor

RIDGES = (0.01, 0.1, 1.0, 10.0, 100.0)  # of coefficients of features scaled to a variance of 1; the last leaves nothing
FOLDS = 5
LEAST_SPREAD = 1e-6  # of a feature that says anything
TOLERANCE = 1e-9  # of the mean log likelihood, relative, and of its slope


class Scene(NamedTuple):
    """Some pixels of one scene."""

    features: Float[Tensor, "n c"]
    squared: Float[Tensor, " n"]
    """Errors."""


class ExpectedErrors(NamedTuple):
    """log variance = weight @ features + bias."""

    weight: Float[Tensor, " c"]
    bias: float
    ridge: float

    def loss(self, scene: Scene) -> float:
        """Twice the negative log likelihood of a pixel's error, but for a constant; the mean over pixels."""
        expected = scene.features @ self.weight + self.bias
        return float((scene.squared * torch.exp(-expected) + expected).mean())


def fitted(scenes: Sequence[Scene]) -> ExpectedErrors:
    """Under which the scenes' errors are likeliest, by the ridge under which those of left-out scenes are.

    ValueError where there is no error at all.
    """
    if not any(scene.squared.any() for scene in scenes):
        pixels = sum(len(scene.squared) for scene in scenes)
        raise ValueError(f"expected errors can be fitted to errors alone, got {pixels} pixels without any")
    losses = dict.fromkeys(RIDGES, 0.0)
    for fold in range(min(FOLDS, len(scenes))):
        others = [scene for k, scene in enumerate(scenes) if k % FOLDS != fold]
        if not any(scene.squared.any() for scene in others):
            continue
        for ridge in RIDGES:
            found = _fitted(others, ridge)
            losses[ridge] += sum(found.loss(scene) for scene in scenes[fold::FOLDS])
    return _fitted(scenes, min(reversed(RIDGES), key=losses.__getitem__))


def _fitted(scenes: Sequence[Scene], ridge: float) -> ExpectedErrors:
    features, squared = (torch.cat(field).numpy() for field in zip(*scenes, strict=True))
    mean, spread = features.mean(0), features.std(0)
    scale = np.where(spread > LEAST_SPREAD, 1 / spread.clip(LEAST_SPREAD), 0)
    scaled = (features - mean) * scale

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
