import itertools
import math

import numpy as np
import pytest
import torch
from event_fixtures import events_of, random_events
from hypothesis import given, settings
from hypothesis import strategies as st

from polarnet.events.representations import event_tensor, voxel_grid_of_window
from polarnet.events.rotation import Rotation, steady_rotation, triggered_rotation
from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import WindowCutter, WindowRule, cut_windows, encode_windows

HEIGHT, WIDTH, DURATION_US = 6, 8, 20_000


CHANNELS = [random_events(seed, 300, DURATION_US - 1, HEIGHT, WIDTH) for seed in range(4)]


def windows(rule, pieces=1):
    """Windows of the cutter for a stream that arrives in several pieces."""
    cutter = WindowCutter(rule, HEIGHT, WIDTH)
    edges = [DURATION_US * k // pieces for k in range(pieces + 1)]
    return [
        window
        for start, stop in itertools.pairwise(edges)
        for window in cutter.add([slice_time(events, start, stop) for events in CHANNELS], stop)
    ]


@pytest.mark.parametrize("rule", [WindowRule(3000, None), WindowRule(3000, 500)])
@pytest.mark.parametrize("pieces", [1, 7, 501])
def test_windows_do_not_depend_on_the_pieces_in_which_a_stream_comes(rule, pieces):
    whole, cut = windows(rule), windows(rule, pieces)
    assert [(w.start_us, w.stop_us) for w in whole] == [(w.start_us, w.stop_us) for w in cut]
    for a, b in zip(whole, cut, strict=True):
        for ours, theirs, all_of_them in zip(a.channels, b.channels, CHANNELS, strict=True):
            assert torch.equal(ours.t, theirs.t)
            assert torch.equal(ours.x, slice_time(all_of_them, a.start_us, a.stop_us).x)


def test_overlapping_windows_end_at_every_step():
    cut = windows(WindowRule(5000, 100))
    assert [w.stop_us for w in cut] == list(range(5000, 20001, 100))
    assert {w.stop_us - w.start_us for w in cut} == {5000}


@pytest.mark.parametrize(("rule", "reason"), [
    ((50, None), "at least 100 us"), ((1000, 50), r"at least 0\.1 ms"),
    ((1000, 2000), "events between windows would be lost"),
])  # fmt: skip
def test_rules_that_make_no_windows_are_refused(rule, reason):
    with pytest.raises(ValueError, match=reason):
        WindowRule(*rule)


def test_an_event_at_a_windows_end_belongs_to_the_next_window_in_batches_and_streams_alike():
    channel = events_of([(t, 0, 0, 1) for t in (0, 400, 999, 1000, 1500, 2000, 3000)], HEIGHT, WIDTH)
    batch = cut_windows(channel, torch.tensor([0, 1000, 2000, 3000]))
    streamed = list(WindowCutter(WindowRule(1000, None), HEIGHT, WIDTH).add([channel] * 4, 3001))
    expected = [[0, 400, 999], [1000, 1500], [2000]]
    assert [window.t.tolist() for window in batch] == expected
    assert [window.channels[0].t.tolist() for window in streamed] == expected


def test_a_time_stamp_far_in_the_future_is_refused_and_a_long_recording_is_not():
    def event(t_us: list[int]) -> Events:
        return events_of([(t, 1, 1, 1) for t in t_us], 4, 4)

    hour_us = 3_600_000_000
    cutter = WindowCutter(WindowRule(hour_us // 2, None), 4, 4, channels=1)
    assert len(list(cutter.add([event([hour_us, 2 * hour_us])], 2 * hour_us))) == 4
    with pytest.raises(ValueError, match=r"got none between 7200000000 and 10000000000000 us: a damaged time stamp"):
        cutter.add([event([10**13])], 10**13 + 1)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 100), max_size=40), st.sets(st.integers(0, 100), min_size=2, max_size=6))
def test_windows_share_out_all_events_from_the_first_frame_to_before_the_last(times, edges):
    events = events_of([(t, 0, 0, 1) for t in sorted(times)], 1, 1)
    parts = cut_windows(events, torch.tensor(sorted(edges)))
    inside = slice_time(events, min(edges), max(edges))
    assert torch.cat([part.t for part in parts]).tolist() == inside.t.tolist()


def test_images_of_a_representation_stay_together_and_frame_times_must_increase():
    t_us = torch.tensor([0, 6_000, 13_000])
    inputs = encode_windows(CHANNELS, t_us, voxel_grid_of_window)
    assert inputs.shape == (2, 20, HEIGHT, WIDTH)
    assert torch.equal(inputs[1, 5:10], voxel_grid_of_window(slice_time(CHANNELS[1], 6_000, 13_000), 7_000))
    assert encode_windows([Events.empty(2, 3)], torch.tensor([5, 6]), event_tensor).shape == (1, 1, 2, 3)
    for times in ([5, 5], [5, 6, 6], [5]):
        with pytest.raises(ValueError, match="at least two frame times, each later than the last"):
            encode_windows([Events.empty(2, 3)], torch.tensor(times), event_tensor)


def test_a_steady_polarizer_turns_evenly_and_triggers_follow_an_uneven_rotation():
    rotation, back = steady_rotation(2.0, math.radians(20)), steady_rotation(-1.0)
    assert np.degrees(rotation.at(np.array([0, 125_000, 1_125_000]))) == pytest.approx([20, 110, 830])
    assert np.degrees(back.at(np.array([250_000]))) == pytest.approx([-90])
    assert (rotation.half_turn_us, back.rate_hz, back.half_turn_us) == (250_000, -1.0, 500_000)
    rotation = triggered_rotation(np.array([1000, 2000, 4000]), math.radians(10))
    assert np.degrees(rotation.at(np.array([1000, 1500, 3000, 6000]))) == pytest.approx([10, 190, 550, 1090])
    assert np.degrees(rotation.since(1000).at(np.array([500]))) == pytest.approx([190])


def test_a_polarizer_at_rest_and_a_single_trigger_are_refused():
    with pytest.raises(ValueError, match="a rate in turns per second other than 0"):
        steady_rotation(0.0)
    with pytest.raises(ValueError, match="at least two trigger times, got 1"):
        triggered_rotation(np.array([5]))
    with pytest.raises(ValueError, match="expected increasing times"):
        Rotation(np.array([1.0, 1.0]), np.array([0.0, 1.0]))
