"""Encodings of events, against cases worked by hand."""

import math

import pytest
import torch
from event_fixtures import events_of
from hypothesis import given, settings
from hypothesis import strategies as st

from polarnet.events.representations import (
    REPRESENTATIONS,
    channels_of,
    event_counts,
    event_tensor,
    normalise_nonzero,
    voxel_grid,
)
from polarnet.events.stream import Events


def test_event_tensor_weighs_polarity_by_time_since_the_first_event(make_events):
    """Paper Eq. 5 with t0 = 100: pixel (0, 0) 1 * 0 + 1 * 10/50, pixel (1, 0) -1 * 25/50, pixel (2, 1) +1 * 50/50."""
    events = make_events([(100, 0, 0, 1), (110, 0, 0, 1), (125, 1, 0, -1), (150, 2, 1, 1)], 2, 3)
    torch.testing.assert_close(event_tensor(events, 50), torch.tensor([[0.2, -0.5, 0.0], [0.0, 0.0, 1.0]]))


def test_event_counts_are_the_net_and_the_total_number_of_events(make_events):
    events = make_events([(1, 0, 0, 1), (2, 0, 0, 1), (3, 0, 0, -1), (4, 2, 1, -1)], 2, 3)
    assert event_counts(events, 50).tolist() == [[[1, 0, 0], [0, 0, -1]], [[3, 0, 0], [0, 0, 1]]]


def test_voxel_grid_has_the_first_event_in_the_first_bin_and_the_last_in_the_last(make_events):
    """Five bins over 400 us: t = 0, 130 and 400 lie at 0, 1.3 and 4."""
    events = make_events([(1000, 0, 0, 1), (1130, 1, 0, -1), (1400, 0, 0, 1)], 1, 2)
    grid = voxel_grid(events, 5)
    torch.testing.assert_close(grid[:, 0, 0], torch.tensor([1.0, 0, 0, 0, 1]))
    torch.testing.assert_close(grid[:, 0, 1], torch.tensor([0, -0.7, -0.3, 0, 0]))


@pytest.mark.parametrize("count", [1, 3])
def test_events_of_a_single_instant_fall_into_bin_zero(make_events, count):
    grid = voxel_grid(make_events([(7, 0, 0, -1)] * count, 1, 1), 5)
    assert grid.flatten().tolist() == [-count, 0, 0, 0, 0]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 3), st.sampled_from([-1, 1])), max_size=30))
def test_the_bins_of_a_voxel_grid_add_up_to_the_polarities_of_each_pixel(rows):
    rows = sorted(rows)
    events = events_of([(t, x, 0, p) for t, x, p in rows], 1, 4)
    expected = torch.zeros(4).index_add(0, events.x.long(), events.p.float())
    torch.testing.assert_close(voxel_grid(events, 5).sum(0)[0], expected, atol=1e-5, rtol=0)


def test_normalising_gives_the_entries_that_are_not_zero_mean_0_and_deviation_1_if_they_differ():
    """Entries 1, 3, 5, 7: mean 4, deviation sqrt(5)."""
    grid = torch.tensor([[[1.0, 0.0], [3.0, 5.0]], [[0.0, 0.0], [7.0, 0.0]]])
    expected = torch.tensor([[[-3.0, 0.0], [-1.0, 1.0]], [[0.0, 0.0], [3.0, 0.0]]]) / math.sqrt(5)
    torch.testing.assert_close(normalise_nonzero(grid), expected)
    assert normalise_nonzero(torch.full((1, 2, 2), 3.0)).abs().max() == 0
    assert normalise_nonzero(torch.zeros(1, 2, 2)).abs().max() == 0
    assert normalise_nonzero(torch.tensor([[[0.0, 3.0], [0.0, 0.0]]])).abs().max() == 0


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_every_representation_of_no_events_is_zero_and_has_its_number_of_channels(name):
    encode = REPRESENTATIONS[name]
    image = encode(Events.empty(4, 6), 33_333)
    assert image.dtype == torch.float32
    assert image.abs().max() == 0
    assert image.shape == ((channels_of(encode), 4, 6) if image.ndim == 3 else (4, 6))
    assert channels_of(encode) == {"event_tensor": 1, "event_counts": 2, "voxel_grid": 5}[name]


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_an_encoding_does_not_depend_on_the_number_of_threads(name, make_random_events):
    events = make_random_events(3, 200_000, 33_333, 60, 90)
    threads = torch.get_num_threads()
    try:
        images = []
        for count in (1, 2):
            torch.set_num_threads(count)
            images.append(REPRESENTATIONS[name](events, 33_333))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*images)
