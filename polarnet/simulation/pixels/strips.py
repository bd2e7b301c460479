"""A plane is worked on in strips of whole rows, small enough to stay in the fastest cache."""

import numpy as np

from polarnet.simulation.compilation import compiled

STRIP = 4000  # pixels, about
SPARE = 8  # entries that `flagged` may write beyond the pixels of a strip


@compiled
def rows_of_strip(h, w):
    """Rows of a strip."""
    return min(h, 1 + STRIP // w)


@compiled
def flag_words(pixels):
    """A byte for each pixel, eight to a word, all 0."""
    return np.zeros((pixels + 7) // 8, np.uint64)


@compiled
def flags_of(words, pixels):
    """The bytes of the first pixels, to be set to 0 or 1."""
    words[(pixels - 1) // 8] = 0  # of which the last strip of a plane may leave some unset
    return words.view(np.uint8)[:pixels]


@compiled
def flagged(words, pixels, positions, groups):
    """Write the positions of the flags that are set, among the first `pixels`, into `positions`; how many they are.

    Which pixels fire is not to be guessed, so there is no branch on it. `groups` is scratch; both hold 8 more entries
    than there are pixels.
    """
    marked = 0
    for group in range((pixels + 7) // 8):
        groups[np.uint64(marked)] = group  # unsigned: numba checks other indices for being negative
        marked += words[group] != 0
    flags, found = words.view(np.uint8), 0
    for m in range(marked):
        group = groups[m]
        for j in range(8 * group, 8 * group + 8):
            positions[np.uint64(found)] = j
            found += flags[np.uint64(j)]
    return found
