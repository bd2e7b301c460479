"""Parameters that each sequence draws: the mapping `randomise` of a section of params.yaml."""

import dataclasses
import math
from typing import Any

from polarnet.runtime.machine import generator_for
from polarnet.runtime.sections import section

LOGARITHMIC = ("_hz", "_per_s", "extinction_ratio")
"""Name suffixes of the parameters whose logarithm is drawn uniformly: rates, bandwidths, ratios."""
NAMES = ("model", "refractory")
"""Parameters that are one of several names, each listed name as likely as the others."""


@section
class RandomisedConfig:
    """A section whose parameters may differ from sequence to sequence."""

    randomise: dict[str, list[float | str]] | None
    """Draws of each sequence: [lowest, highest] of a number, or the names that a parameter of NAMES may take.

    A name that is listed twice is drawn twice as often. null: nothing is drawn.
    """

    def __post_init__(self):
        for name, values in (self.randomise or {}).items():
            if name not in _drawable(self):
                raise ValueError(f"randomise.{name}: expected one of {', '.join(_drawable(self))}, got {name!r}")
            if name in NAMES and not values:
                raise ValueError(f"randomise.{name}: expected at least one name, got {values}")
            if name not in NAMES:
                _check_bounds(name, values)
            present = getattr(self, name)
            for value in values:
                whole = [value] * len(present) if isinstance(present, list) else value
                try:
                    dataclasses.replace(self, randomise=None, **{name: whole})
                except ValueError as error:
                    first_line, _, _ = str(error).partition("\n")  # the others say the same of further list values
                    raise ValueError(f"randomise.{first_line}") from None


def _drawable(config: RandomisedConfig) -> list[str]:
    """Names of the parameters that are numbers, or lists of numbers, or in NAMES."""
    numbers = {name for name, value in vars(config).items() if not isinstance(value, (str, bool, dict))}
    return [name for name in vars(config) if name in numbers.union(NAMES) - {"randomise"}]


def _check_bounds(name: str, values: list[float | str]) -> None:
    numbers = [value for value in values if isinstance(value, float)]
    if len(values) != 2 or numbers != values or numbers[0] > numbers[1]:
        raise ValueError(f"randomise.{name}: expected [lowest, highest], got {values}")
    if name.endswith(LOGARITHMIC) and numbers[0] <= 0:
        raise ValueError(f"randomise.{name}: expected a lowest value > 0, got {values}; the logarithm is drawn")


def draws(config: RandomisedConfig, seed: int, sequence: str) -> dict[str, Any]:
    """Values that a sequence draws, by parameter; each value of a list is drawn separately.

    A draw depends only on seed, sequence, parameter and range, so that other ranges do not change it.
    """
    values: dict[str, Any] = {}
    for name, listed in (config.randomise or {}).items():
        generator, present = generator_for(seed, sequence, name), getattr(config, name)
        if name in NAMES:
            values[name] = listed[int(generator.integers(len(listed)))]
            continue
        logarithmic = name.endswith(LOGARITHMIC)
        lowest, highest = (math.log(bound) if logarithmic else bound for bound in map(float, listed))
        drawn = generator.uniform(lowest, highest, len(present) if isinstance(present, list) else 1).tolist()
        drawn = [math.exp(value) for value in drawn] if logarithmic else drawn
        values[name] = drawn if isinstance(present, list) else drawn[0]
    return values
