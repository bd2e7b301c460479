"""Hot pixels of a channel, which fire at random times whatever their light, and lose the events of their light.

Their events are a Poisson process, which has no memory: each span of time draws its own (`columns.write_in_order`), so
a clip that is continued needs no state of its hot pixels.
"""

from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from polarnet.runtime.compilation import compiled
from polarnet.runtime.sections import section
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.physics import MAX_RATE_HZ
from polarnet.simulation.pixels.randomness import key_for, mixed, uniform


@section
class DefectsConfig:
    """Hot pixels, for every pixel model."""

    hot_pixel_share: Annotated[float, Field(ge=0, le=1)]
    """Probability that a pixel is hot: it fires at random times, whatever its light."""
    hot_pixel_rate_hz: Annotated[float, Field(ge=0, le=MAX_RATE_HZ)]
    """Events per second of a hot pixel, ON and OFF together; 0: it is dead."""


class Defects(NamedTuple):
    """Hot pixels of a channel."""

    hot: np.ndarray  # int64, their indices, rising
    silent: np.ndarray  # bool [h * w], whether a pixel's own events are dropped; empty for a sensor without defects
    rate_hz: float
    round_up: bool  # whether the pixel model stamps an event after the start of its step and up to its end


def defects_of(config: DefectsConfig, pixels: int, key: np.uint64, channel: int, round_up: bool) -> Defects:
    """The hot pixels of a channel."""
    if config.hot_pixel_share == 0:
        return Defects(np.empty(0, np.int64), np.empty(0, np.bool_), config.hot_pixel_rate_hz, round_up)
    hot = _chosen(key, randomness.HOT, channel, pixels, config.hot_pixel_share)
    return Defects(np.flatnonzero(hot), hot, config.hot_pixel_rate_hz, round_up)


@compiled
def _chosen(key, purpose, channel, pixels, share):
    """Whether each pixel of a channel is chosen, with the probability `share`."""
    key, chosen = key_for(key, purpose, channel), np.empty(pixels, np.bool_)
    for i in range(pixels):
        chosen[i] = uniform(mixed(key, i)) < share
    return chosen
