import pytest
import torch

from polarnet.analysis.event_budget import (
    by_window_length,
    growing_window,
    last_window,
    recovered_alone,
    sequence_at,
    since_start,
)
from polarnet.benchmark.rows import opened
from polarnet.events.streaming import events_per_pixel
from polarnet.methods import METHODS
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore
from polarnet.storage.scenes import SceneStore


def test_events_per_pixel_is_the_mean_over_channels_before_each_time(sequence):
    t_us = sequence.t_us
    per_pixel = events_per_pixel(sequence.events, t_us)
    assert per_pixel[-1].item() == pytest.approx(300 / (18 * 20))
    half = sum(int((e.t < 2000).sum()) for e in sequence.events) / (4 * 18 * 20)
    assert per_pixel[2].item() == pytest.approx(half)


def test_a_growing_window_holds_all_events_so_far_and_the_last_window_as_many_as_asked(sequence, context):
    recoverer = opened(METHODS["ours"], context)
    growing = [growing_window(sequence.events, t_us) for t_us in (1000, 2000)]
    for window, stop_us in zip(growing, (1000, 2000), strict=True):
        assert (window.start_us, window.stop_us) == (0, stop_us)
        assert list(map(len, window.channels)) == [int((events.t < stop_us).sum()) for events in sequence.events]
    last = last_window(sequence.events, 50, 2000)
    assert list(map(len, last.channels)) == [50] * 4
    assert last.stop_us == 2000 > max(int(events.t[-1]) for events in last.channels)
    assert last.start_us == min(int(events.t[0]) for events in last.channels)
    together = recovered_alone([*growing, last], recoverer)
    torch.testing.assert_close(together[1], recovered_alone(growing[1:], recoverer)[0])
    torch.testing.assert_close(together[2], recovered_alone([last], recoverer)[0])


def test_every_frame_falls_into_one_bin_of_events_per_pixel(make_sequence, context):
    sequences = [make_sequence(name, seed=k) for k, name in enumerate("ab")]
    table = since_start(sequences, ["zeros", "oracle_mean"], context)
    assert sum(entry["frames"] for entry in table["zeros"]) == 2 * 4
    for entry in table["zeros"]:
        assert entry["from"] <= entry["events_per_pixel"] <= entry["to"]
    for entry in table["oracle_mean"]:
        assert entry["skill"] == pytest.approx(0, abs=1e-6)


def test_windows_twice_as_long_are_half_as_many_with_twice_the_events(simulated, context):
    scenes, events = SceneStore.open(simulated.scenes), EventStore.open(simulated.events)
    assert scenes.duration_us("a-0") == 200_000
    table = by_window_length(scenes, events, ["a-0"], [20_000, 40_000], 0, ["zeros", "oracle_mean"], context)
    short, long = table["zeros"]
    assert (short["window_us"], short["frames"]) == (20_000, 10)
    assert (long["window_us"], long["frames"]) == (40_000, 5)
    assert long["events_per_pixel"] == pytest.approx(2 * short["events_per_pixel"], rel=1e-6)
    total = sum(len(channel) for channel in events.read("a-0")) / (4 * 18 * 24)
    assert 10 * short["events_per_pixel"] == pytest.approx(total, rel=1e-3)  # but for events at time 0
    with pytest.raises(ValueError, match="a-0: windows of 150000 us leave none after the first 160000 us of 200000 us"):
        by_window_length(scenes, events, ["a-0"], [150_000], 160_000, ["zeros"], context)


def test_truth_at_any_time_lies_between_that_of_the_frames(simulated):
    scenes, frames = SceneStore.open(simulated.scenes), FrameStore.open(simulated.frames)
    t_us = frames.t_us("a-0")
    result = sequence_at(scenes, "a-0", [], t_us)
    torch.testing.assert_close(result.dolp, frames.frames("a-0", 1).dolp, atol=1e-5, rtol=0)
    finer = sequence_at(scenes, "a-0", [], torch.arange(0, int(t_us[-1]) + 1, 5000))
    assert len(finer.dolp) == int(t_us[-1]) // 5000
