"""Expected errors: once a network is trained, how large they are is fitted to what may tell it.

While a network learns, its errors change, and a likelihood of them teaches it little more than how large they are on
the whole. When the training is over they stay as they are. Then the logarithm of the expected squared error, as a
linear function of what may tell it (features), is the likeliest one of normal distributions: a convex problem. Pixels
are many and scenes are few: what tells a scene's errors from another's is believed as far as it does so for scenes that
were left out of the fit, and where it does not, errors are expected to be the same everywhere.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

RIDGES = (0.01, 0.1, 1.0, 10.0, 100.0)  # of coefficients of features scaled to a variance of 1; the last leaves nothing
FOLDS = 5
THINNED = 16  # times fewer pixels while a ridge is chosen
LEAST_SPREAD = 1e-6  # of a feature that says anything
ROUNDS = 50  # of Newton's method, which is there after a few
ENOUGH = 1e-7  # of a mean log likelihood, not to be improved any more


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
    thin = [Scene(*(field[::THINNED] for field in scene)) for scene in scenes]
    losses = dict.fromkeys(RIDGES, 0.0)
    for fold in range(min(FOLDS, len(thin))):
        others = [scene for k, scene in enumerate(thin) if k % FOLDS != fold]
        if not any(scene.squared.any() for scene in others):
            continue
        for ridge in RIDGES:
            found = _fitted(others, ridge)
            losses[ridge] += sum(found.loss(scene) for scene in thin[fold::FOLDS])
    return _fitted(scenes, min(reversed(RIDGES), key=losses.__getitem__))


def _fitted(scenes: Sequence[Scene], ridge: float) -> ExpectedErrors:
    features, squared = (torch.cat(field) for field in zip(*scenes, strict=True))
    mean, spread = features.mean(0), features.std(0, correction=0)
    scale = torch.where(spread > LEAST_SPREAD, 1 / spread.clamp(min=LEAST_SPREAD), 0)
    x = torch.cat([(features - mean) * scale, torch.ones_like(squared)[:, None]], dim=1)
    shrink = torch.cat([torch.full_like(mean, 2 * ridge), mean.new_zeros(1)])
    w = torch.cat([torch.zeros_like(mean), squared.mean().log()[None]])

    def loss(w: Tensor) -> Tensor:
        expected = x @ w
        return (squared * torch.exp(-expected) + expected).mean() + (shrink * w.square()).sum() / 2

    before = loss(w)
    for _ in range(ROUNDS):
        relative = squared * torch.exp(-(x @ w))
        slope = (x * (1 - relative)[:, None]).mean(0) + shrink * w
        bend = x.T @ (x * relative[:, None]) / len(x) + torch.diag(shrink)
        step = torch.linalg.solve(bend, slope)
        while (after := loss(w - step)) > before + ENOUGH:
            step = step / 2
        w = w - step
        if before - after < ENOUGH:
            break
        before = after
    weight = w[:-1] * scale
    return ExpectedErrors(weight, float(w[-1] - weight @ mean), ridge)
