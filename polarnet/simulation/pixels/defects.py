"""Hot and dead pixels of a channel: hot ones fire at random times whatever their light, dead ones never fire.

Both kinds lose the events of their own light. Those of a hot pixel are a Poisson process, which has no memory: each
span of `SPAN_US` draws its own, so a clip that is continued needs no state of its hot pixels.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from polarnet.runtime.sections import section
from polarnet.simulation.compilation import ONE, ZERO, compiled
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.columns import Columns, empty_columns, trimmed, with_room
from polarnet.simulation.pixels.randomness import key_for, mixed, uniform

Share = Annotated[float, Field(ge=0, le=1)]
MAX_RATE_HZ = 1e5  # a pixel's refractory period allows no more
SPAN_US = 1 << 16  # span of time whose events a hot pixel draws independently of other spans


@section
class DefectsConfig:
    """Hot and dead pixels, for every pixel model."""

    hot_pixel_share: Share
    """Probability that a pixel is hot: it fires at random times, whatever its light."""
    hot_pixel_rate_hz: Annotated[float, Field(ge=0, le=MAX_RATE_HZ)]
    """Events per second of a hot pixel, ON and OFF together."""
    dead_pixel_share: Share
    """Probability that a pixel is dead: it never fires."""


class Defects(NamedTuple):
    """Defective pixels of a channel."""

    hot: np.ndarray  # int64, indices of the hot pixels, rising
    silent: np.ndarray  # bool [h * w], whether a pixel's own events are dropped
    rate_hz: float
    key: np.uint64  # seed of all noise of the sensor
    channel: int


def defects_of(config: DefectsConfig, pixels: int, key: np.uint64, channel: int) -> Defects | None:
    """The defective pixels of a channel; None if the sensor has none. A pixel drawn as both is dead."""
    if config.hot_pixel_share == 0 and config.dead_pixel_share == 0:
        return None
    dead = _chosen(key, randomness.DEAD, channel, pixels, config.dead_pixel_share)
    hot = _chosen(key, randomness.HOT, channel, pixels, config.hot_pixel_share) & ~dead
    return Defects(np.flatnonzero(hot), hot | dead, config.hot_pixel_rate_hz, key, channel)


@compiled
def _chosen(key, purpose, channel, pixels, share):
    """Whether each pixel of a channel is chosen, with the probability `share`."""
    key, chosen = key_for(key, purpose, channel), np.empty(pixels, np.bool_)
    for i in range(pixels):
        chosen[i] = uniform(mixed(key, i)) < share
    return chosen


def with_defects(
    columns: Columns, defects: Defects, width: int, start_us: float, stop_us: float, rounds_up: bool
) -> Columns:
    """The events of a channel without those of its defective pixels and with hot events, in the order (t, y, x, p).

    Hot pixels fire at times start <= t < stop, rounded down to whole microseconds, or up if `rounds_up`.
    """
    expected = len(defects.hot) * defects.rate_hz * 1e-6 * (stop_us - start_us)
    room = empty_columns(16 + int(1.5 * expected))
    hot = trimmed(*_hot_events(defects, width, start_us, stop_us, rounds_up, room))
    in_order = np.lexsort((hot.p, hot.x, hot.y, hot.t))
    hot = Columns(*(column[in_order] for column in hot))
    order = _merged_order(columns, hot, defects.silent, width)
    return Columns(*(np.concatenate(pair)[order] for pair in zip(columns, hot, strict=True)))


@compiled
def _hot_events(defects, width, start_us, stop_us, rounds_up, columns):
    """Write the events of the hot pixels, pixel by pixel; returns the columns and the number of events."""
    used, mean_us = ZERO, 1e6 / defects.rate_hz
    key = ~key_for(defects.key, randomness.HOT, defects.channel)  # the key itself chose the pixels
    for i in defects.hot:
        pixel_key = mixed(key, i)
        for span in range(math.floor(start_us / SPAN_US), math.ceil(stop_us / SPAN_US)):
            span_key, time_us, draw = mixed(pixel_key, span), np.float64(span * SPAN_US), 0
            span_stop_us = min(np.float64((span + 1) * SPAN_US), stop_us)
            while True:
                time_us -= math.log(uniform(mixed(span_key, draw))) * mean_us
                if time_us >= span_stop_us:
                    break
                draw += 2
                if time_us < start_us:
                    continue
                columns = with_room(columns, used, ONE)
                columns.t[used] = math.ceil(time_us) if rounds_up else math.floor(time_us)
                columns.y[used], columns.x[used] = i // width, i % width
                columns.p[used] = 1 if mixed(span_key, draw - 1) >> np.uint64(63) else -1
                used += 1
    return columns, used


@compiled
def _merged_order(columns, hot, silent, width):
    """Indices into `columns` followed by `hot` that sort the events in time and leave out those of silent pixels."""
    n, m = columns.t.size, hot.t.size
    order, written, k = np.empty(n + m, np.int64), 0, 0
    for i in range(n):
        if silent[np.int64(columns.y[i]) * width + columns.x[i]]:
            continue
        while k < m and (hot.t[k], hot.y[k], hot.x[k]) < (columns.t[i], columns.y[i], columns.x[i]):
            order[written] = n + k
            written, k = written + 1, k + 1
        order[written] = i
        written += 1
    for rest in range(k, m):
        order[written] = n + rest
        written += 1
    return order[:written]
