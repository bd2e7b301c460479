"""Growing columns for the events of one channel, and the order of events with equal times."""

from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled

SIGNAL, LEAK, SHOT = 0, 1, 2


class Columns(NamedTuple):
    """Events of one channel, one array per field. `label` and `unrounded_us` are empty unless requested."""

    t: np.ndarray
    """int64, microseconds"""
    x: np.ndarray
    """int16, column"""
    y: np.ndarray
    """int16, row"""
    p: np.ndarray
    """int8, +1 or -1"""
    label: np.ndarray
    """uint8, the process behind the event: SIGNAL, LEAK or SHOT"""
    unrounded_us: np.ndarray
    """float64, microseconds before rounding to t"""


EVENT_BYTES = 8 + 2 + 2 + 1


def empty_columns(capacity: int, labels: bool, unrounded_times: bool) -> Columns:
    """Columns with room for `capacity` events."""
    # One allocation for all four: the system gives large blocks as huge pages, which costs far fewer page faults.
    block = np.empty(capacity * EVENT_BYTES, np.uint8)
    return Columns(
        block[: 8 * capacity].view(np.int64),
        block[8 * capacity : 10 * capacity].view(np.int16),
        block[10 * capacity : 12 * capacity].view(np.int16),
        block[12 * capacity :].view(np.int8),
        np.empty(capacity if labels else 0, np.uint8),
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
        _grown_column(columns.label, used, capacity) if columns.label.size else columns.label,
        _grown_column(columns.unrounded_us, used, capacity) if columns.unrounded_us.size else columns.unrounded_us,
    )


@compiled
def sort_ties(columns, start, stop):
    """Sort events start .. stop by (t, y, x, p), by insertion: they are nearly in order of t already."""
    for i in range(start + 1, stop):
        t, x, y, p = columns.t[i], columns.x[i], columns.y[i], columns.p[i]
        label = columns.label[i] if columns.label.size else np.uint8(0)
        unrounded_us = columns.unrounded_us[i] if columns.unrounded_us.size else 0.0
        j = i
        while j > start and _after(columns, j - 1, t, y, x, p):
            columns.t[j], columns.x[j], columns.y[j], columns.p[j] = (
                columns.t[j - 1],
                columns.x[j - 1],
                columns.y[j - 1],
                columns.p[j - 1],
            )
            if columns.label.size:
                columns.label[j] = columns.label[j - 1]
            if columns.unrounded_us.size:
                columns.unrounded_us[j] = columns.unrounded_us[j - 1]
            j -= 1
        columns.t[j], columns.x[j], columns.y[j], columns.p[j] = t, x, y, p
        if columns.label.size:
            columns.label[j] = label
        if columns.unrounded_us.size:
            columns.unrounded_us[j] = unrounded_us


@compiled
def _after(columns, i, t, y, x, p):
    if columns.t[i] != t:
        return columns.t[i] > t
    if columns.y[i] != y:
        return columns.y[i] > y
    if columns.x[i] != x:
        return columns.x[i] > x
    return columns.p[i] > p
