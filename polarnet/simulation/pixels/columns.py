"""Growing columns for the events of one channel, and the order (t, y, x, p) of events."""

from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled, inlined

TIME_SHIFT, ROW_SHIFT, COLUMN_SHIFT = np.int64(31), np.int64(16), np.int64(1)


class Columns(NamedTuple):
    """Events of one channel, one array per field. `unrounded_us` is empty unless requested."""

    t: np.ndarray
    """int64, microseconds"""
    x: np.ndarray
    """int16, column"""
    y: np.ndarray
    """int16, row"""
    p: np.ndarray
    """int8, +1 or -1"""
    unrounded_us: np.ndarray
    """float64, microseconds before rounding to t"""


EVENT_BYTES = 8 + 2 + 2 + 1


def empty_columns(capacity: int, unrounded_times: bool) -> Columns:
    """Uninitialised arrays for up to `capacity` events of a channel."""
    # One allocation for all four: the system gives large blocks as huge pages, which costs far fewer page faults.
    block = np.empty(capacity * EVENT_BYTES, np.uint8)
    return Columns(
        block[: 8 * capacity].view(np.int64),
        block[8 * capacity : 10 * capacity].view(np.int16),
        block[10 * capacity : 12 * capacity].view(np.int16),
        block[12 * capacity :].view(np.int8),
        np.empty(capacity if unrounded_times else 0, np.float64),
    )


def trimmed(columns: Columns, count: int) -> Columns:
    """The first `count` events."""
    return Columns(*(column[:count] for column in columns))


@compiled
def _grown_column(column, used, capacity):
    larger = np.empty(capacity, column.dtype)
    larger[:used] = column[:used]
    return larger


@compiled
def with_room(columns, used, more):
    """`columns` if `more` events fit after the first `used`, else a copy of at least twice the size."""
    if used + more <= columns.t.size:
        return columns
    capacity = max(2 * columns.t.size, used + more)
    return Columns(
        _grown_column(columns.t, used, capacity),
        _grown_column(columns.x, used, capacity),
        _grown_column(columns.y, used, capacity),
        _grown_column(columns.p, used, capacity),
        _grown_column(columns.unrounded_us, used, capacity) if columns.unrounded_us.size else columns.unrounded_us,
    )


@inlined
def place_of(y, x):
    """Bits of row and column in the integer that `event_of` makes of an event."""
    return np.int64(y) << ROW_SHIFT | np.int64(x) << COLUMN_SHIFT


@inlined
def event_of(offset_us, place, on):
    """Pack an event into an int64, so that integers sort by (t, y, x, p).

    From the highest bits: microseconds since a base time (32 bits), row (15), column (15), 1 for ON (1).
    """
    return np.int64(offset_us) << TIME_SHIFT | place | np.int64(on)


@compiled
def sort_ties(columns, start, stop):
    """Sort the events from `start` up to `stop` by (t, y, x, p), in place."""
    events = np.empty(stop - start, np.int64)
    for i in range(events.size):
        t_us, place = columns.t[start + i] - columns.t[start], place_of(columns.y[start + i], columns.x[start + i])
        events[i] = event_of(t_us, place, columns.p[start + i] > 0)
    order = start + np.argsort(events, kind="mergesort")
    columns.t[start:stop], columns.x[start:stop] = columns.t[order], columns.x[order]
    columns.y[start:stop], columns.p[start:stop] = columns.y[order], columns.p[order]
    if columns.unrounded_us.size:
        columns.unrounded_us[start:stop] = columns.unrounded_us[order]
