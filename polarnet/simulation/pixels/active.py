"""Pixels that may fire in a step, gathered into columns, so that each operation on them is one loop."""

from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled, inlined


class Active(NamedTuple):
    """One entry per pixel that may fire. Times are float64, in microseconds since the start of the step."""

    pixel: np.ndarray  # int32, index into the channel
    scratch: np.ndarray  # int32, working memory
    change: np.ndarray  # float64, log intensity since the last event, at time `now`
    now: np.ndarray  # time up to which the pixel has been followed
    slope: np.ndarray  # float64, log intensity per microsecond from the light alone
    last_event: np.ndarray  # time of the last event
    next_change: np.ndarray  # float64, change right after this round's event, or `change` if there is none
    next_now: np.ndarray  # time of this round's event, or `now` if there is none
    final_change: np.ndarray  # float64, change at the end of the step if no event follows
    event: np.ndarray  # int64, this round's event as `columns.event_of` encodes it
    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak: np.ndarray  # float32, log intensity per microsecond until the next event
    leak_nominal: np.ndarray
    events: np.ndarray  # int32, number of events so far
    fires: np.ndarray  # uint8, 1 if the pixel fires in this round
    continues: np.ndarray  # uint8, 1 if the pixel may fire in the next round


@compiled
def empty_active(capacity):
    """Uninitialised arrays for up to `capacity` pixels."""
    doubles, floats, events = np.empty((7, capacity)), np.empty((4, capacity), np.float32), np.empty(capacity, np.int64)
    ints, flags = np.empty((3, capacity), np.int32), np.empty((2, capacity), np.uint8)
    return Active(
        ints[0], ints[1],
        doubles[0], doubles[1], doubles[2], doubles[3], doubles[4], doubles[5], doubles[6], events,
        floats[0], floats[1], floats[2], floats[3], ints[2],
        flags[0], flags[1],
    )  # fmt: skip


@inlined
def gather(source, index, target):
    """target[a] = source[index[a]]; `target` may be `source` if the index rises."""
    for a in range(index.size):
        target[a] = source[np.uint64(index[a])]  # unsigned: numba checks other indices for being negative


@inlined
def scatter(source, index, target):
    """target[index[a]] = source[a]."""
    for a in range(index.size):
        target[np.uint64(index[a])] = source[a]


@inlined
def keep_continuing(active, count):
    """Move the entries of the first `count` pixels that may fire again to the front; returns their number."""
    index, remaining = active.scratch[:count], 0
    for a in range(count):
        index[np.uint64(remaining)] = a
        remaining += active.continues[a]
    index = index[:remaining]
    gather(active.pixel, index, active.pixel)
    gather(active.next_change, index, active.change)
    gather(active.next_now, index, active.now)
    gather(active.slope, index, active.slope)
    gather(active.last_event, index, active.last_event)
    gather(active.threshold_on, index, active.threshold_on)
    gather(active.threshold_off, index, active.threshold_off)
    gather(active.leak, index, active.leak)
    gather(active.leak_nominal, index, active.leak_nominal)
    gather(active.events, index, active.events)
    return remaining
