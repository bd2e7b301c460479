"""Estimates of a sensor's parameters with their standard errors."""

from typing import NamedTuple

GROUPS = 8  # groups of pixels, whose differences give standard errors
MAX_RELATIVE_ERROR = 0.5  # an estimate with a larger standard error is discarded


class Estimate(NamedTuple):
    """A parameter of the sensor."""

    value: float
    error: float
    """Standard error."""
    source: str  # recordings and events behind the estimate, in words
