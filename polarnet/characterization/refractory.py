"""The refractory period of a sensor, from the shortest intervals between events of a pixel."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from polarnet.characterization.estimates import Estimate

PILE_UP = 3.0  # intervals of 0.9 to 1.1 times the shortest, over those of 1.1 to 1.3 times the shortest
MIN_TICKS = 5  # ticks of the recording's clock in the shortest refractory period that can be measured
SHORTEST = 5  # rank of the interval that shot noise is judged by, so that a few false events do not count
MAX_ERROR = 0.05  # relative; without a refractory period the error is about as large as the estimate


def piled_up_us(durations_us: Sequence[Float64[np.ndarray, " _"]]) -> Estimate | None:
    """Shortest interval, if intervals pile up there: crossings within the refractory period waited for its end."""
    durations = np.concatenate(durations_us) if durations_us else np.empty(0)
    durations = np.sort(durations[durations > 0])
    supported = max(5, int(1e-5 * len(durations)))
    if len(durations) <= supported:
        return None
    shortest = durations[supported]
    if shortest < MIN_TICKS * _tick_us(durations):
        return None  # a coarse clock piles intervals up as well
    edges = np.searchsorted(durations, shortest * np.array([0.9, 1.1, 1.3]))
    piled, next_to = np.diff(edges)
    if piled < 20 or piled < PILE_UP * next_to:
        return None
    near = durations[edges[0] : edges[1]]
    return Estimate(float(np.median(near)), float(near.std()) / math.sqrt(len(near)), "shortest intervals of a pixel")


def between_shot_noise_us(durations_us: Float64[np.ndarray, " _"]) -> Estimate | None:
    """Refractory period from intervals under constant light.

    Shot noise is a Poisson process that pauses for the refractory period. Just above it, the density of intervals is
    constant, so the k-th shortest interval exceeds it by k over the density.
    """
    durations = np.sort(durations_us[durations_us > 0])
    if len(durations) < SHORTEST:
        return None
    shortest = durations[SHORTEST - 1]
    density = (np.searchsorted(durations, 3 * shortest) - SHORTEST) / (2 * shortest)
    value, error = shortest - SHORTEST / max(density, 1e-12), math.sqrt(SHORTEST) / max(density, 1e-12)
    if error > MAX_ERROR * value or shortest < MIN_TICKS * _tick_us(durations):
        return None
    return Estimate(float(value), float(error), "shortest intervals of shot noise")


def _tick_us(durations: Float64[np.ndarray, " _"]) -> float:
    """Step of the recording's clock."""
    return float(np.gcd.reduce(np.rint(durations).astype(np.int64)))
