"""Events of one step of one channel: collected pixel by pixel, then written in the order (t, y, x, p).

An event is the integer of `columns.event_of`, with its time in whole microseconds since the step's start.
"""

import math
from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled
from polarnet.simulation.pixels.columns import COLUMN_SHIFT, ROW_SHIFT, TIME_SHIFT, sort_ties, with_room

PLACE_MASK = np.int64(0x7FFF)
MAX_BUCKETS = 4096  # buckets of the counting sort; a step shorter than 4096 us has one bucket per microsecond


class Pending(NamedTuple):
    """Events of one step in any order."""

    events: np.ndarray
    """int64, see `columns.event_of`"""
    unrounded_us: np.ndarray
    """float64, times before rounding; empty if not requested"""
    in_order: np.ndarray
    """int64, scratch"""


@compiled
def pending_events(capacity, unrounded_times):
    """Uninitialised arrays for up to `capacity` events of a step."""
    return Pending(
        np.empty(capacity, np.int64), np.empty(capacity if unrounded_times else 0), np.empty(capacity, np.int64)
    )


@compiled
def roomier(pending):
    """The same events with room for twice as many."""
    n = pending.events.size
    larger = pending_events(2 * n, pending.unrounded_us.size > 0)
    larger.events[:n] = pending.events
    larger.unrounded_us[: pending.unrounded_us.size] = pending.unrounded_us
    return larger


@compiled
def write_in_order(pending, n, start_us, stop_us, columns, used):
    """Append the n pending events of a step to the first `used` of the columns, in the order (t, y, x, p).

    Returns the columns, enlarged where necessary, and the new number of events.
    """
    base_us = np.int64(math.floor(start_us))
    longest_us = np.int64(math.ceil(stop_us)) - base_us
    columns = with_room(columns, used, n)
    if columns.unrounded_us.size:
        columns.unrounded_us[used : used + n] = pending.unrounded_us[:n][
            np.argsort(pending.events[:n], kind="mergesort")
        ]
    _sort(pending.events[:n], longest_us, pending.in_order[:n])
    t, x, y, p = columns.t[used : used + n], columns.x[used:], columns.y[used:], columns.p[used:]
    for i in range(n):
        event = pending.in_order[i]
        t[i] = base_us + (event >> TIME_SHIFT)
        x[i] = event >> COLUMN_SHIFT & PLACE_MASK
        y[i] = event >> ROW_SHIFT & PLACE_MASK
        p[i] = (event & np.int64(1)) * np.int64(2) - np.int64(1)
    tied = used  # a step that does not start at a whole microsecond can share one with the step before it
    while n > 0 and tied > 0 and columns.t[tied - 1] >= columns.t[used]:
        tied -= 1
    if tied < used:
        sort_ties(columns, tied, used + n)
    return columns, used + n


@compiled
def _sort(events, longest_us, in_order):
    """Sort `events` into `in_order`: by counting over buckets of time, then by insertion within each bucket."""
    shift = TIME_SHIFT
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
