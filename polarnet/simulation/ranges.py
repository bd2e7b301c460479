"""Parameters of the sensor that each sequence draws: `emulate.randomise` of params.yaml."""

import dataclasses
import math
from typing import Any

from polarnet.runtime.machine import generator_for

LOGARITHMIC = "_hz"
"""Name suffix of the parameters whose logarithm is drawn uniformly: rates and bandwidths."""
NAMES = ("model", "refractory")
"""Parameters that are one of several names, each listed name as likely as the others."""


def check_ranges(config: Any) -> None:
    """ValueError for ranges of an `EmulatorConfig` that are not ranges, or beyond those of their parameter."""
    drawable = [name for name, value in vars(config).items() if name in NAMES or not isinstance(value, str)]
    drawable.remove("randomise")
    for name, values in (config.randomise or {}).items():
        if name not in drawable:
            raise ValueError(f"randomise.{name}: expected one of {', '.join(drawable)}, got {name!r}")
        if name in NAMES and not values:
            raise ValueError(f"randomise.{name}: expected at least one name, got {values}")
        if name not in NAMES:
            _check_bounds(name, values)
        for value in values:
            try:
                dataclasses.replace(config, randomise=None, **{name: value})
            except ValueError as error:
                raise ValueError(f"randomise.{error}") from None


def _check_bounds(name: str, values: list[float | str]) -> None:
    numbers = [value for value in values if isinstance(value, float)]
    if len(values) != 2 or numbers != values or numbers[0] > numbers[1]:
        raise ValueError(f"randomise.{name}: expected [lowest, highest], got {values}")
    if name.endswith(LOGARITHMIC) and numbers[0] <= 0:
        raise ValueError(f"randomise.{name}: expected a lowest value > 0, got {values}; the logarithm is drawn")


def draws(config: Any, seed: int, sequence: str) -> dict[str, Any]:
    """Values that a sequence draws from the ranges of an `EmulatorConfig`, by parameter.

    A draw depends only on seed, sequence, parameter and range, so that other ranges do not change it.
    """
    values: dict[str, Any] = {}
    for name, listed in (config.randomise or {}).items():
        generator = generator_for(seed, sequence, name)
        if name in NAMES:
            values[name] = listed[int(generator.integers(len(listed)))]
            continue
        lowest, highest = listed
        if name.endswith(LOGARITHMIC):
            values[name] = math.exp(generator.uniform(math.log(lowest), math.log(highest)))
        else:
            values[name] = generator.uniform(lowest, highest)
    return values
