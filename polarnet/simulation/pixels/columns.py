"""Events of one channel as growing columns, and those of one step, brought into the order (t, y, x, p).

The kernels collect the events of a step in any order, each as one integer (`event_of`). Defective pixels lose theirs
here, and hot ones get their own: a Poisson process, which has no memory. Each span of time draws its own, so that a
clip that is continued needs no state of its hot pixels.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import compiled, inlined
from polarnet.simulation.pixels import randomness
from polarnet.simulation.pixels.physics import Physics
from polarnet.simulation.pixels.randomness import key_for, mixed, uniform

TIME_SHIFT, ROW_SHIFT, COLUMN_SHIFT, PLACE_MASK = np.int64(31), np.int64(16), np.int64(1), np.int64(0x7FFF)
MAX_STEP_US = (1 << 32) - 4  # room of `event_of`, less what rounding to whole microseconds adds
MAX_TIME_US = 1 << 53  # larger whole numbers do not all fit float64
EVENT_BYTES = 8 + 2 + 2 + 1
SPAN_US = 1 << 16  # span of time whose events a hot pixel draws independently of other spans
MAX_BUCKETS = 4096  # buckets of the counting sort; a step shorter than 4096 us has one bucket per microsecond


class Columns(NamedTuple):
    """Events of one channel, one array per field."""

    t: np.ndarray  # int64, microseconds
    x: np.ndarray  # int16, column
    y: np.ndarray  # int16, row
    p: np.ndarray  # int8, +1 or -1


class Defects(NamedTuple):
    """Hot pixels of a channel, which fire at random times whatever their light, and lose the events of their light."""

    hot: np.ndarray  # int64, their indices, rising
    silent: np.ndarray  # bool [h * w], whether a pixel's own events are dropped; empty for a sensor without defects
    rate_hz: float
    round_up: bool  # whether the pixel model stamps an event after the start of its step and up to its end


class Steps(NamedTuple):
    """A span of time of one channel. Step k lasts from times_us[k] to times_us[k + 1] and ends with one frame."""

    physics: Physics
    height: int
    width: int
    times_us: np.ndarray  # float64 [steps + 1], strictly increasing
    first_frame: int  # index into the light of the frame at times_us[1]
    first_number: int  # steps that the channel has taken before; random draws are numbered by it
    key: np.uint64  # seed of all noise of the sensor
    channel: int  # each channel has its own mismatch and noise
    defects: Defects


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


def empty_columns(capacity: int) -> Columns:
    """Uninitialised arrays for up to `capacity` events of a channel."""
    # One allocation for all four: the system gives large blocks as huge pages, which costs far fewer page faults.
    block = np.empty(capacity * EVENT_BYTES, np.uint8)
    t, x, y, p = np.split(block, [8 * capacity, 10 * capacity, 12 * capacity])
    return Columns(t.view(np.int64), x.view(np.int16), y.view(np.int16), p.view(np.int8))


@compiled
def _grown(column, used, capacity):
    larger = np.empty(capacity, column.dtype)
    larger[:used] = column[:used]
    return larger


@compiled
def roomier(pending):
    """The same pending events of a step (int64, see `event_of`) with room for twice as many."""
    return _grown(pending, pending.size, 2 * pending.size)


@inlined
def place_of(y, x):
    """Bits of row and column in the integer that `event_of` makes of an event."""
    return np.int64(y) << ROW_SHIFT | np.int64(x) << COLUMN_SHIFT


@inlined
def pixel_place(pixel, width):
    """`place_of` a pixel by its index; quicker than a division of whole numbers."""
    y = np.int64((pixel + 0.5) / width)
    return place_of(y, pixel - y * width)


@inlined
def event_of(offset_us, place, on):
    """An event as an int64: microseconds since the step's start (32 bits), row (15), column (15), 1 for ON (1)."""
    return np.int64(offset_us) << TIME_SHIFT | place | np.int64(on)


@compiled
def write_in_order(steps, k, pending, n, columns, used):
    """Append the n pending events of step k to the `used` of the columns in the order (t, y, x, p); return both.

    Events that are pending in this order, as those of v2e mostly are, cost no sorting.
    """
    start_us, stop_us = steps.times_us[k], steps.times_us[k + 1]
    if steps.defects.silent.size:
        pending, n = _with_defects(steps, start_us, stop_us, pending, n)
    base_us = np.int64(math.floor(start_us))
    if used + n > columns.t.size:
        t, x, y, p = columns
        size = max(2 * t.size, used + n)
        columns = Columns(_grown(t, used, size), _grown(x, used, size), _grown(y, used, size), _grown(p, used, size))
    in_order, rising = pending[:n], 1
    while rising < n and pending[rising - 1] <= pending[rising]:
        rising += 1
    if rising < n:
        in_order = _sorted(pending[:n], np.int64(math.ceil(stop_us)) - base_us)
    t, x, y, p = columns.t[used : used + n], columns.x[used:], columns.y[used:], columns.p[used:]
    for i in range(n):
        event = in_order[i]
        t[i] = base_us + (event >> TIME_SHIFT)
        x[i] = event >> COLUMN_SHIFT & PLACE_MASK
        y[i] = event >> ROW_SHIFT & PLACE_MASK
        p[i] = (event & np.int64(1)) * np.int64(2) - np.int64(1)
    # a step that does not start at a whole microsecond can share one with the step before it
    tied = used
    while n > 0 and tied > 0 and columns.t[tied - 1] >= columns.t[used]:
        tied -= 1
    if tied < used:
        _sort_ties(columns, tied, used + n)
    return columns, used + n


@compiled
def _with_defects(steps, start_us, stop_us, pending, n):
    """The pending events of a step without those of defective pixels and with those of hot ones, and their number.

    Hot pixels fire at times start <= t < stop, rounded down to whole microseconds, or up if `defects.round_up`.
    """
    defects, kept, mean_us = steps.defects, 0, 1e6 / steps.defects.rate_hz
    for m in range(n):
        event = pending[m]
        pending[kept] = event
        pixel = (event >> ROW_SHIFT & PLACE_MASK) * steps.width + (event >> COLUMN_SHIFT & PLACE_MASK)
        kept += not defects.silent[pixel]
    key = ~key_for(steps.key, randomness.HOT, steps.channel)  # the key itself chose the pixels
    for i in defects.hot:
        pixel_key, place = mixed(key, i), place_of(i // steps.width, i % steps.width)
        for span in range(math.floor(start_us / SPAN_US), math.ceil(stop_us / SPAN_US)):
            span_key, draw = mixed(pixel_key, span), 0
            time_us = span * SPAN_US - math.log(uniform(mixed(span_key, draw))) * mean_us
            while time_us < min(np.float64((span + 1) * SPAN_US), stop_us):
                if time_us >= start_us:
                    if kept == pending.size:
                        pending = roomier(pending)
                    whole_us = math.ceil(time_us) if defects.round_up else math.floor(time_us)
                    on = mixed(span_key, draw + 1) >> np.uint64(63)
                    pending[kept] = event_of(whole_us - math.floor(start_us), place, on)
                    kept += 1
                draw += 2
                time_us -= math.log(uniform(mixed(span_key, draw))) * mean_us
    return pending, kept


@compiled
def _sort_ties(columns, start, stop):
    """Sort the events from `start` up to `stop` by (t, y, x, p), in place."""
    events = np.empty(stop - start, np.int64)
    for i in range(events.size):
        t_us, place = columns.t[start + i] - columns.t[start], place_of(columns.y[start + i], columns.x[start + i])
        events[i] = event_of(t_us, place, columns.p[start + i] > 0)
    order = start + np.argsort(events, kind="mergesort")
    columns.t[start:stop], columns.x[start:stop] = columns.t[order], columns.x[order]
    columns.y[start:stop], columns.p[start:stop] = columns.y[order], columns.p[order]


@compiled
def _sorted(events, longest_us):
    """Sort `events` by counting over buckets of time, then by insertion within each bucket."""
    in_order, shift = np.empty_like(events), TIME_SHIFT
    while longest_us >> (shift - TIME_SHIFT) >= MAX_BUCKETS:
        shift += 1
    starts = np.zeros((longest_us >> (shift - TIME_SHIFT)) + 2, np.int32)
    for i in range(events.size):
        starts[np.uint64((events[i] >> shift) + 1)] += 1  # unsigned: numba checks other indices for being negative
    total = np.int32(0)
    for b in range(starts.size):
        total += starts[b]
        starts[b] = total
    for i in range(events.size):
        bucket = np.uint64(events[i] >> shift)
        in_order[np.uint64(starts[bucket])] = events[i]
        starts[bucket] += 1
    for i in range(1, events.size):
        event, j = in_order[np.uint64(i)], i
        if in_order[np.uint64(i - 1)] > event:
            while j > 0 and in_order[j - 1] > event:
                in_order[j] = in_order[j - 1]
                j -= 1
            in_order[j] = event
    return in_order
