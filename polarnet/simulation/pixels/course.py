"""Pixels that are followed through a step together: their state in columns, so that each operation is one loop."""

from typing import NamedTuple

import numpy as np

from polarnet.simulation.compilation import compiled, inlined


class Course(NamedTuple):
    """One entry for each pixel that may fire; times in microseconds since the start of the step."""

    pixel: np.ndarray
    """int32, number in the plane"""
    entry: np.ndarray
    """int32, scratch"""
    change: np.ndarray
    """float64, log intensity since the last event at time `now`"""
    now: np.ndarray
    """float64"""
    drift: np.ndarray
    """float64, log intensity per microsecond that the light brings"""
    last_event: np.ndarray
    """float64"""
    after: np.ndarray
    """float64, change right after the pixel's event if it has one in this round, else `change`"""
    since: np.ndarray
    """float64, time of that event, else `now`"""
    at_end: np.ndarray
    """float64, change at the end of the step if there is no further event"""
    kind: np.ndarray
    """int64, what the number of that event says of its polarity and label"""
    threshold_on: np.ndarray
    threshold_off: np.ndarray
    leak: np.ndarray
    leak_nominal: np.ndarray
    events: np.ndarray
    """int32, fired so far"""
    fires: np.ndarray
    """uint8, whether there is an event in this round"""
    again: np.ndarray
    """uint8, whether there may be another one"""


@compiled
def empty_course(m):
    """Room for m pixels."""
    doubles, floats = np.empty((7, m)), np.empty((4, m), np.float32)
    ints, flags = np.empty((3, m), np.int32), np.empty((2, m), np.uint8)
    return Course(
        ints[0], ints[1],
        doubles[0], doubles[1], doubles[2], doubles[3], doubles[4], doubles[5], doubles[6], np.empty(m, np.int64),
        floats[0], floats[1], floats[2], floats[3], ints[2],
        flags[0], flags[1],
    )  # fmt: skip


@inlined
def take(source, index, to):
    """to[a] = source[index[a]]; `to` may be `source` if the index rises."""
    for a in range(index.size):
        to[a] = source[np.uint64(index[a])]  # unsigned: numba checks other indices for being negative


@inlined
def put(source, index, to):
    """to[index[a]] = source[a]."""
    for a in range(index.size):
        to[np.uint64(index[a])] = source[a]


@inlined
def keep(course, active):
    """Keep those of the first `active` pixels that may fire again, with what the next round needs; how many."""
    index, remaining = course.entry[:active], 0
    for a in range(active):
        index[np.uint64(remaining)] = a
        remaining += course.again[a]
    index = index[:remaining]
    take(course.pixel, index, course.pixel)
    take(course.after, index, course.change)
    take(course.since, index, course.now)
    take(course.drift, index, course.drift)
    take(course.last_event, index, course.last_event)
    take(course.threshold_on, index, course.threshold_on)
    take(course.threshold_off, index, course.threshold_off)
    take(course.leak, index, course.leak)
    take(course.leak_nominal, index, course.leak_nominal)
    take(course.events, index, course.events)
    return remaining
