"""Allowed values of configuration fields: declared beside the field, checked when the dataclass is made."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any


def allowed(
    *,
    above: float | int | None = None,
    low: float | int | None = None,
    high: float | int | None = None,
    choices: Sequence[str] = (),
) -> Mapping[str, Any]:
    """Metadata of a dataclass field: > above, >= low, <= high, or one of choices. Lists are checked item by item."""
    return {"above": above, "low": low, "high": high, "choices": tuple(choices)}


def describe(metadata: Mapping[str, Any]) -> str:
    """The values that `allowed` admits, in words."""
    if metadata["choices"]:
        return "one of " + ", ".join(metadata["choices"])
    words = [
        f"{sign} {metadata[bound]}"
        for bound, sign in (("above", ">"), ("low", ">="), ("high", "<="))
        if metadata[bound] is not None
    ]
    return " and ".join(words)


def check_ranges(config: Any) -> None:
    """Raise a ValueError that names the first field of a dataclass outside its declared range."""
    for field in dataclasses.fields(config):
        if "choices" not in field.metadata:
            continue
        value = getattr(config, field.name)
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if item is not None and not _admits(field.metadata, item):
                raise ValueError(f"{field.name}: expected {describe(field.metadata)}, got {value!r}")


def _admits(metadata: Mapping[str, Any], value: Any) -> bool:
    if metadata["choices"]:
        return value in metadata["choices"]
    above, low, high = metadata["above"], metadata["low"], metadata["high"]
    return (
        math.isfinite(value)
        and (above is None or value > above)
        and (low is None or value >= low)
        and (high is None or value <= high)
    )
