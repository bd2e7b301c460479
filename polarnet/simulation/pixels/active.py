"""Strips of whole rows that fit the fastest cache, flags on their pixels, and the flagged pixels as columns."""

from typing import NamedTuple

import numpy as np

from polarnet.runtime.compilation import borrowing, compiled, inlined

STRIP = 4000  # pixels, approximately
SPARE = 8  # entries that `flagged` may write beyond the pixels of a strip


@compiled
def rows_of_strip(h, w):
    """Number of rows of a strip."""
    return min(h, 1 + STRIP // w)


@compiled
def flag_words(pixels):
    """Flags of pixels, all 0: one byte per pixel, eight bytes to a word."""
    return np.zeros((pixels + 7) // 8, np.uint64)


@compiled
def flags_of(words, pixels):
    """Flags of the first `pixels` pixels as a view of bytes, each of which the caller sets to 0 or 1."""
    words[(pixels - 1) // 8] = 0  # the last strip may leave bytes of this word unset
    return words.view(np.uint8)[:pixels]


@borrowing
def flagged(words, pixels, positions, groups):
    """Write the indices of the flags set among the first `pixels` into `positions`; returns their number.

    There is no branch on a flag, because it would be unpredictable. `groups` is scratch. Both arrays need room for
    `pixels` + SPARE entries.
    """
    marked = 0
    for group in range((pixels + 7) // 8):
        groups[np.uint64(marked)] = group  # unsigned: numba checks other indices for being negative
        marked += words[group] != 0
    flags, count = words.view(np.uint8), 0
    for m in range(marked):
        group = groups[m]
        for j in range(8 * group, 8 * group + 8):
            positions[np.uint64(count)] = j
            count += flags[np.uint64(j)]
    return count


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
    words: np.ndarray  # uint64, flags of the pixels of a strip


@compiled
def empty_active(batch, strip):
    """Uninitialised arrays for up to `batch` pixels and those of another strip of `strip` pixels."""
    capacity = batch + strip + SPARE
    d, f, events = np.empty((7, capacity)), np.empty((4, capacity), np.float32), np.empty(capacity, np.int64)
    i, b = np.empty((3, capacity), np.int32), np.empty((2, capacity), np.uint8)
    return Active(
        i[0], i[1], d[0], d[1], d[2], d[3], d[4], d[5], d[6], events, f[0], f[1], f[2], f[3], i[2], b[0], b[1],
        flag_words(strip),
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
