"""The refractory period, from the shortest intervals between events of a pixel, and the intervals it leaves alone."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from polarnet.events.intervals import Intervals

GROUPS = 8  # groups of pixels, whose differences give standard errors
MAX_RELATIVE_ERROR = 0.5  # an estimate with a larger standard error is discarded
PILE_UP = 3.0  # intervals of 0.9 to 1.1 times the shortest, over those of 1.1 to 1.3 times the shortest
MIN_TICKS = 5  # ticks of the recording's clock in the shortest refractory period that can be measured


class Estimate(NamedTuple):
    """A parameter of the sensor."""

    value: float
    error: float
    """Standard error."""
    source: str  # recordings and events behind the estimate, in words


def undisturbed(intervals: Intervals, refractory_us: float, margin: float = 1.3) -> Intervals:
    """Intervals longer than `margin` times the refractory period, except those right after a shorter one.

    A crossing within the refractory period waits for its end: its increment exceeds one threshold, and the next
    increment lacks the excess.
    """
    free = intervals.duration_us > margin * refractory_us
    after_waiting = np.zeros(len(free), bool)
    after_waiting[1:] = (intervals.pixel[1:] == intervals.pixel[:-1]) & ~free[:-1]
    return intervals.chosen(free & ~after_waiting)


def piled_up_us(durations_us: Sequence[Float64[np.ndarray, " _"]]) -> Estimate | None:
    """Shortest interval, if intervals pile up there: crossings within the refractory period waited for its end."""
    durations = np.concatenate(durations_us) if durations_us else np.empty(0)
    durations = np.sort(durations[durations > 0])
    supported = max(5, int(1e-5 * len(durations)))
    if len(durations) <= supported:
        return None
    shortest = durations[supported]
    tick_us = float(np.gcd.reduce(np.rint(durations).astype(np.int64)))  # step of the recording's clock
    if shortest < MIN_TICKS * tick_us:
        return None  # a coarse clock piles intervals up as well
    edges = np.searchsorted(durations, shortest * np.array([0.9, 1.1, 1.3]))
    piled, next_to = np.diff(edges)
    if piled < 20 or piled < PILE_UP * next_to:
        return None
    near = durations[edges[0] : edges[1]]
    return Estimate(float(np.median(near)), float(near.std()) / math.sqrt(len(near)), "shortest intervals of a pixel")
