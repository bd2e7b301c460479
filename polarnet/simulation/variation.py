"""Variants of training scenes: AoLP rotated, DoLP rescaled or drawn towards one value, intensity regraded.

Photographs are highly polarized, because saturation becomes DoLP; measured scenes are hardly polarized. Variants lie in
between and have any angle, so that a network cannot learn the averages of one kind of scene. In uniform polarization
the four channels change alike for any DoLP, and the only cue left is the pixel's response to dim and bright light:
`uniform_share` makes more such scenes.
"""

import math
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field, NonNegativeFloat, NonNegativeInt
from torch import Tensor

from polarnet import stokes
from polarnet.runtime.sections import one_of, section

MAX_DOLP = 0.99
SPACINGS = ("linear", "logarithmic")


@section
class VariationConfig:
    """Section `variation` of params.yaml."""

    scenes_per_picture: NonNegativeInt
    """Variants of each training picture, beside the picture itself; other splits have none."""
    share: Annotated[float, Field(ge=0, le=1)]
    """Share of variants with changed DoLP, and share with changed S0; AoLP is rotated in all."""
    dolp_factor: list[NonNegativeFloat]
    """[smallest, largest] factor on DoLP."""
    dolp_exponent_spread: NonNegativeFloat
    """DoLP is first raised to a power whose natural logarithm has mean 0 and this standard deviation."""
    dolp_spacing: Annotated[str, one_of(SPACINGS)]
    """Distribution of the factor; logarithmic makes a DoLP of a few percent as frequent as a large one."""
    s0_factor: list[Annotated[float, Field(gt=0, le=1)]]
    s0_exponent_spread: NonNegativeFloat
    uniform_share: Annotated[float, Field(ge=0, le=1)]
    """Share of variants whose polarization is drawn towards a uniform one of random DoLP and AoLP."""
    uniform_weight: list[Annotated[float, Field(ge=0, le=1)]]
    """[smallest, largest] weight of the uniform polarization; 1: DoLP and AoLP are constant."""

    def __post_init__(self):
        for name in ("dolp_factor", "s0_factor", "uniform_weight"):
            values = getattr(self, name)
            if len(values) != 2 or values[0] > values[1]:
                raise ValueError(f"{name}: expected [smaller, larger], got {values}")
        if self.dolp_spacing == "logarithmic" and self.dolp_factor[0] == 0:
            raise ValueError(f"dolp_factor: expected numbers above 0 for logarithmic spacing, got {self.dolp_factor}")


def varied(
    polarization: Float[Tensor, "3 h w"], config: VariationConfig, generator: np.random.Generator
) -> Float[Tensor, "3 h w"]:
    """A variant (S0, DoLP, AoLP) of a scene; S0 in [0, 1], DoLP below 1, AoLP in [0, pi)."""
    s0, dolp, aolp = polarization
    turn, direction = generator.uniform(0, math.pi), 1 - 2 * int(generator.integers(2))
    aolp = torch.remainder(direction * aolp + turn, math.pi)
    aolp = torch.where(aolp >= math.pi, 0.0, aolp)  # values just below 0 round up to pi
    if generator.random() < config.share:
        dolp = _graded(dolp, config.dolp_factor, config.dolp_exponent_spread, generator, config.dolp_spacing)
        dolp = dolp.clamp(max=MAX_DOLP)
    if generator.random() < config.share:
        s0 = _graded(s0, config.s0_factor, config.s0_exponent_spread, generator)
    if generator.random() < config.uniform_share:  # the weighted mean of the scene's (s1, s2) and a constant
        lightest, heaviest = config.uniform_weight
        share = generator.uniform(lightest, heaviest)
        degree, angle = generator.uniform(0, MAX_DOLP), generator.uniform(0, math.pi)
        mean = stokes.stokes_from_polarization(torch.ones_like(dolp), (1 - share) * dolp, aolp)
        mean[1] += share * degree * math.cos(2 * angle)
        mean[2] += share * degree * math.sin(2 * angle)
        dolp, aolp = stokes.dolp(mean).clamp(max=MAX_DOLP), stokes.aolp(mean)
    return torch.stack([s0, dolp, aolp])


def _graded(
    values: Tensor, factor: list[float], spread: float, generator: np.random.Generator, spacing: str = SPACINGS[0]
) -> Tensor:
    exponent = math.exp(generator.normal(0, spread))
    low, high = factor
    if spacing == "logarithmic":
        multiplier = math.exp(generator.uniform(math.log(low), math.log(high)))
    else:
        multiplier = generator.uniform(low, high)
    powers = values.clamp(0, 1).double() ** exponent  # float32 would depend on the processor
    return (multiplier * powers).to(values.dtype)
