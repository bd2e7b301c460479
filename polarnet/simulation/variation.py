"""Other scenes from the same pictures, to train on: their polarization turned, rescaled or evened out, their light
regraded.

Photographs are highly polarized by the rule that saturation is DoLP, measured scenes hardly: what is trained on
scenes in between, whose angles are any, does not learn one world's averages. A scene of about one hue is polarized
alike everywhere. Then the four polarizers' logarithms change alike, whatever DoLP is, and only how a pixel responds to
dim and to bright light tells; `uniform_share` makes more such scenes.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from polarnet import stokes
from polarnet.runtime.ranges import allowed, check_ranges

MAX_DOLP = 0.99


@dataclass(frozen=True)
class VariationConfig:
    """Section `variation` of params.yaml."""

    scenes_per_picture: int = field(metadata=allowed(low=0))
    """Of the training split, beside the picture itself; pictures of the other splits are never varied."""
    share: float = field(metadata=allowed(low=0, high=1))
    """Of them whose DoLP is changed, and of them whose light is; the angle is turned in all."""
    dolp_factor: list[float] = field(metadata=allowed(low=0))
    """DoLP is multiplied by a number between these two, drawn uniformly ..."""
    dolp_exponent_spread: float = field(metadata=allowed(low=0))
    """... after it was raised to a power whose logarithm is normal with this standard deviation."""
    s0_factor: list[float] = field(metadata=allowed(above=0, high=1))
    s0_exponent_spread: float = field(metadata=allowed(low=0))
    uniform_share: float = field(metadata=allowed(low=0, high=1))
    """Of them whose polarization is drawn towards one of any degree and angle, the same everywhere ..."""
    uniform_weight: list[float] = field(metadata=allowed(low=0, high=1))
    """... by a weight between these two; 1: DoLP and AoLP are constant."""

    def __post_init__(self):
        check_ranges(self)
        for name in ("dolp_factor", "s0_factor", "uniform_weight"):
            values = getattr(self, name)
            if len(values) != 2 or values[0] > values[1]:
                raise ValueError(f"{name}: expected a smaller and a greater number, got {values}")


def varied(
    polarization: Float[Tensor, "3 h w"], config: VariationConfig, generator: np.random.Generator
) -> Float[Tensor, "3 h w"]:
    """Another scene (S0, DoLP, AoLP) of the same shapes; S0 in [0, 1], DoLP below 1, AoLP in [0, pi)."""
    s0, dolp, aolp = polarization
    turn, direction = generator.uniform(0, math.pi), 1 - 2 * int(generator.integers(2))
    aolp = torch.remainder(direction * aolp + turn, math.pi)
    aolp = torch.where(aolp >= math.pi, 0.0, aolp)  # what is just below 0 rounds up
    if generator.random() < config.share:
        dolp = _graded(dolp, config.dolp_factor, config.dolp_exponent_spread, generator).clamp(max=MAX_DOLP)
    if generator.random() < config.share:
        s0 = _graded(s0, config.s0_factor, config.s0_exponent_spread, generator)
    if generator.random() < config.uniform_share:
        dolp, aolp = _evened(dolp, aolp, config.uniform_weight, generator)
    return torch.stack([s0, dolp, aolp])


def _evened(
    dolp: Float[Tensor, "h w"], aolp: Float[Tensor, "h w"], weight: list[float], generator: np.random.Generator
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """DoLP and AoLP of a mean of the scene's own S1 / S0, S2 / S0 and a constant."""
    lightest, heaviest = weight
    share = generator.uniform(lightest, heaviest)
    degree, angle = generator.uniform(0, MAX_DOLP), generator.uniform(0, math.pi)
    mean = stokes.stokes_from_polarization(torch.ones_like(dolp), (1 - share) * dolp, aolp)
    mean[1] += share * degree * math.cos(2 * angle)
    mean[2] += share * degree * math.sin(2 * angle)
    return stokes.dolp(mean).clamp(max=MAX_DOLP), stokes.aolp(mean)


def _graded(values: Tensor, factor: list[float], spread: float, generator: np.random.Generator) -> Tensor:
    exponent = math.exp(generator.normal(0, spread))
    low, high = factor
    return generator.uniform(low, high) * values.clamp(0, 1) ** exponent
