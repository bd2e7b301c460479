"""Hot pixels of a channel, which fire at random times whatever their light, and lose the events of their light.

Their events are a Poisson process, which has no memory: each span of time draws its own (`columns.write_in_order`), so
a clip that is continued needs no state of its hot pixels.
"""

from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import compiled
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.randomness import key_for, mixed, uniform


class Defects(NamedTuple):
    """Hot pixels of a channel."""

    hot: np.ndarray  # int64, their indices, rising
    silent: np.ndarray  # bool [h * w], whether a pixel's own events are dropped; empty for a sensor without defects
    rate_hz: float
    round_up: bool  # whether the pixel model stamps an event after the start of its step and up to its end


def defects_of(share: float, rate_hz: float, pixels: int, key: np.uint64, channel: int, round_up: bool) -> Defects:
    """The hot pixels of a channel: each pixel with probability `share`."""
    hot = _chosen(key, randomness.HOT, channel, pixels, share) if share > 0 else np.empty(0, np.bool_)
    return Defects(np.flatnonzero(hot), hot, rate_hz, round_up)


@compiled
def _chosen(key, purpose, channel, pixels, share):
    """Whether each pixel of a channel is chosen, with the probability `share`."""
    key, chosen = key_for(key, purpose, channel), np.empty(pixels, np.bool_)
    for i in range(pixels):
        chosen[i] = uniform(mixed(key, i)) < share
    return chosen
