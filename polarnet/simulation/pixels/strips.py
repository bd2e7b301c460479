"""A plane is worked on in strips of whole rows, small enough to stay in the fastest cache."""

import numpy as np

from polarnet.simulation.compilation import compiled

STRIP = 4000  # pixels, about
EIGHT = np.uint64(8)
BYTE_NUMBERS = np.uint64(0x0001020304050607)  # 256^i times this has i in its highest byte


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
def flagged(words, pixels, positions):
    """Write the positions of the flags that are set, among the first `pixels`, into `positions`; how many they are.

    Few pixels fire in a step: a word without a flag is passed over, and set flags are found by arithmetic.
    """
    found = 0
    for group in range((pixels + 7) // 8):
        word = words[group]
        while word:
            lowest = word & (~word + np.uint64(1))
            positions[found] = EIGHT * np.uint64(group) + (lowest * BYTE_NUMBERS >> np.uint64(56))
            found += 1
            word ^= lowest
    return found
