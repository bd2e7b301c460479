"""Strips of whole rows, small enough for the fastest cache, and flags on their pixels."""

import numpy as np

from polarnet.simulation.compilation import borrowing, compiled

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
