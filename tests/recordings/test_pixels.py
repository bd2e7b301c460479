"""Hot pixels."""

import numpy as np
import torch

from polarnet.events.stream import Events
from polarnet.recordings.pixels import event_counts, hot_pixels, without_pixels


def busy(generator, height=20, width=30, each=20):
    """Events all over the sensor, more of them in its right half, for a second."""
    counts = np.full((height, width), each)
    counts[:, width // 2 :] *= 5
    counts[3, 4] = 900
    y, x = (np.repeat(axis.ravel(), counts.ravel()) for axis in np.indices(counts.shape))
    order = generator.permutation(len(x))
    t = np.sort(generator.integers(0, 1_000_000, len(x)))
    p = generator.choice([-1, 1], len(x)).astype(np.int8)
    columns = (t, x[order].astype(np.int16), y[order].astype(np.int16), p)
    return Events(*map(torch.from_numpy, columns), height, width), counts


def hot_of(events):
    """Those of a recording of a second."""
    return hot_pixels(event_counts(events), 1.0, 5)


def test_a_pixel_that_fires_much_more_than_those_around_it_is_hot_and_an_edge_is_not():
    events, counts = busy(np.random.default_rng(0))
    assert np.array_equal(event_counts(events), counts)
    assert np.argwhere(hot_of(events)).tolist() == [[3, 4]]
    clean = without_pixels(events, hot_of(events))
    assert len(clean) == len(events) - 900
    assert event_counts(clean)[3, 4] == 0
    assert (clean.t.diff() >= 0).all()


def test_one_factor_more_than_the_third_busiest_around_is_hot_and_thin_lines_are_not():
    counts = np.ones((40, 60), np.int64)
    counts[10:13] = 50  # an edge that passes
    counts[25, 5:30] = 50  # a line of one pixel
    counts[34, 20] = 100
    counts[34, 40:42] = 100  # two neighbours
    assert np.argwhere(hot_pixels(counts, 1.0, 5)).tolist() == [[34, 20], [34, 40], [34, 41]]


def test_a_few_events_in_no_time_are_not_hot():
    counts = np.zeros((8, 8), np.int64)
    counts[3, 4] = 7
    assert not hot_pixels(counts, 1e-6, 4).any()
    counts[3, 4] = 8
    assert hot_pixels(counts, 1e-6, 4).any()
    assert not hot_pixels(counts, 1.0, 4).any()
