"""Parameters that each sequence draws from a range: the mapping `randomise` of a section of params.yaml."""

import dataclasses
import math
from typing import Annotated, Any

from pydantic import Field

from polarnet.runtime.machine import generator_for
from polarnet.runtime.sections import section

LOGARITHMIC = ("_hz", "_per_s", "extinction_ratio")
"""Name suffixes of the parameters whose logarithm is drawn uniformly: rates, bandwidths, ratios."""


@section
class RandomisedConfig:
    """A section whose numbers may differ from sequence to sequence."""

    randomise: dict[str, Annotated[list[float], Field(min_length=2, max_length=2)]] | None
    """[lowest, highest] of each parameter that is drawn for each sequence; null: none is drawn."""

    def __post_init__(self):
        for name, bounds in (self.randomise or {}).items():
            if name not in vars(self) or name == "randomise":
                raise ValueError(f"randomise.{name}: expected one of {', '.join(_numbers(self))}, got {name!r}")
            lowest, highest = bounds
            if lowest > highest:
                raise ValueError(f"randomise.{name}: expected [lowest, highest], got {bounds}")
            if name.endswith(LOGARITHMIC) and lowest <= 0:
                raise ValueError(
                    f"randomise.{name}: expected a lowest value > 0, got {bounds}; its logarithm is drawn uniformly"
                )
            for bound in bounds:
                try:
                    dataclasses.replace(self, randomise=None, **{name: _repeated(getattr(self, name), bound)})
                except ValueError as error:
                    first_line, _, _ = str(error).partition("\n")  # the others say the same of further list values
                    raise ValueError(f"randomise.{first_line}") from None


def _numbers(config: RandomisedConfig) -> list[str]:
    """Names of the parameters that are numbers, or lists of numbers."""
    return [
        name for name, value in vars(config).items() if not isinstance(value, (str, bool, dict)) and name != "randomise"
    ]


def _repeated(value: Any, number: float) -> Any:
    """`number`, or as many of them as `value` has if that is a list."""
    return [number] * len(value) if isinstance(value, list) else number


def draws(config: RandomisedConfig, seed: int, sequence: str) -> dict[str, Any]:
    """Values that a sequence draws, by parameter; each value of a list is drawn separately.

    A draw depends only on seed, sequence, parameter and range, so that other ranges do not change it.
    """
    values: dict[str, Any] = {}
    for name, bounds in (config.randomise or {}).items():
        generator, logarithmic = generator_for(seed, sequence, name), name.endswith(LOGARITHMIC)
        lowest, highest = map(math.log, bounds) if logarithmic else bounds
        present = getattr(config, name)
        drawn = generator.uniform(lowest, highest, len(present) if isinstance(present, list) else 1).tolist()
        drawn = [math.exp(value) for value in drawn] if logarithmic else drawn
        values[name] = drawn if isinstance(present, list) else drawn[0]
    return values
