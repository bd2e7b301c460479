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


def test_a_pixel_that_fires_much_more_than_those_around_it_is_hot_and_an_edge_is_not():
    events, counts = busy(np.random.default_rng(0))
    assert np.array_equal(event_counts(events), counts)
    assert np.argwhere(hot_pixels(events, 5)).tolist() == [[3, 4]]
    clean = without_pixels(events, hot_pixels(events, 5))
    assert len(clean) == len(events) - 900
    assert event_counts(clean)[3, 4] == 0
    assert (clean.t.diff() >= 0).all()


def test_nothing_is_hot_where_nothing_fires():
    empty = Events.empty(20, 30)
    assert not hot_pixels(empty, 5).any()
    assert len(without_pixels(empty, hot_pixels(empty, 5))) == 0


def test_a_pixel_that_fires_now_and_then_in_a_quiet_recording_is_not_hot():
    t = torch.arange(10) * 100_000
    x = torch.full((10,), 7, dtype=torch.int16)
    assert not hot_pixels(Events(t, x, x, torch.ones(10, dtype=torch.int8), 20, 30), 5).any()
