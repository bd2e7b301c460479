"""Events of one step of one plane: collected pixel by pixel, then written in order of time."""

from typing import NamedTuple

import numpy as np
from numba import njit

from polarnet.simulation.pixels.columns import sort_ties, with_room

FINEST_BUCKETS = 4096  # microseconds of a step that are told apart by counting alone, at no noticeable cost
LABEL_SHIFT = 2  # a kind is (polarity + 1) + 4 * label


class Pending(NamedTuple):
    """Events in the order of their pixels, (y, x), and for one pixel in order of time."""

    offset_us: np.ndarray
    """int32, whole microseconds since the step's first one"""
    place: np.ndarray
    """int32, row * 2^16 + column"""
    kind: np.ndarray
    """uint8, polarity and label"""
    exact_us: np.ndarray
    """float64"""
    order: np.ndarray
    """int32, scratch"""
    buckets: np.ndarray
    """int32, scratch"""


@njit(nogil=True, cache=True)
def pending_events(capacity):
    """Room for `capacity` events."""
    return Pending(
        np.empty(capacity, np.int32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.uint8),
        np.empty(capacity, np.float64),
        np.empty(capacity, np.int32),
        np.empty(FINEST_BUCKETS + 1, np.int32),
    )


@njit(nogil=True, cache=True)
def roomier(pending):
    """The same events with room for twice as many."""
    larger = pending_events(2 * pending.place.size)
    n = pending.place.size
    larger.offset_us[:n], larger.place[:n] = pending.offset_us, pending.place
    larger.kind[:n], larger.exact_us[:n] = pending.kind, pending.exact_us
    return larger


@njit(nogil=True, cache=True, inline="always")
def kind_of(polarity, label):
    """Polarity and label in one small number."""
    return np.uint8((polarity + 1) | (label << LABEL_SHIFT))


@njit(nogil=True, cache=True, error_model="numpy")
def write_in_order(pending, n, base_us, longest_us, columns, used):
    """Append the n pending events to the columns in the order (t, y, x, p); t = base_us + offset_us <= longest_us."""
    columns = with_room(columns, used, n)
    _sort_by_time(pending, n, longest_us)
    t, x, y, p = columns.t[used:], columns.x[used:], columns.y[used:], columns.p[used:]
    for i in range(n):
        e = pending.order[i]
        t[i] = base_us + pending.offset_us[e]
        x[i], y[i] = pending.place[e] & 0xFFFF, pending.place[e] >> 16
        p[i] = np.int8(pending.kind[e] & 3) - 1
    if columns.label.size:
        for i in range(n):
            columns.label[used + i] = pending.kind[pending.order[i]] >> LABEL_SHIFT
    if columns.exact_us.size:
        for i in range(n):
            columns.exact_us[used + i] = pending.exact_us[pending.order[i]]
    tied = used  # a step that does not begin at a whole microsecond can share one with the step before
    while n > 0 and tied > 0 and columns.t[tied - 1] >= columns.t[used]:
        tied -= 1
    if tied < used or _polarities_out_of_order(columns, used, used + n):
        sort_ties(columns, tied, used + n)
    return columns, used + n


@njit(nogil=True, cache=True, error_model="numpy")
def _sort_by_time(pending, n, longest_us):
    """Fill `order`: a counting sort over buckets of time, stable, then insertion where a bucket holds several times."""
    shift = 0
    while longest_us >> shift >= FINEST_BUCKETS:
        shift += 1
    offset, order, starts = pending.offset_us, pending.order, pending.buckets[: (longest_us >> shift) + 2]
    starts[:] = 0
    for i in range(n):
        starts[(offset[i] >> shift) + 1] += 1
    total = np.int32(0)
    for b in range(starts.size):
        total += starts[b]
        starts[b] = total
    for i in range(n):
        b = offset[i] >> shift
        order[starts[b]] = i
        starts[b] += 1
    if shift:
        for i in range(1, n):
            e, j = order[i], i
            while j > 0 and offset[order[j - 1]] > offset[e]:
                order[j] = order[j - 1]
                j -= 1
            order[j] = e


@njit(nogil=True, cache=True, error_model="numpy")
def _polarities_out_of_order(columns, start, stop):
    """Whether a pixel has an ON before an OFF event within one microsecond."""
    found = False
    for i in range(start + 1, stop):
        same = (columns.t[i] == columns.t[i - 1]) & (columns.y[i] == columns.y[i - 1]) & (columns.x[i] == columns.x[i - 1])
        found |= same & (columns.p[i] < columns.p[i - 1])
    return found
