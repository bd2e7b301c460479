import pytest
import torch

from polarnet.analysis.between_windows import frames_between
from polarnet.analysis.event_budget import (
    EVENTS_PER_PIXEL,
    between_windows,
    by_sliding_window,
    by_window_length,
    growing_window,
    last_window,
    recovered_alone,
    since_start,
    sliding_recovery,
)
from polarnet.analysis.resimulate import StoredSequences
from polarnet.benchmark.rows import opened
from polarnet.config.tree import load
from polarnet.events.streaming import events_per_pixel
from polarnet.methods import METHODS
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore


@pytest.fixture
def recoverer(context):
    return opened(METHODS["ours"], context)


def test_events_per_pixel_is_the_mean_over_channels_before_each_time(sequence):
    t_us = sequence.t_us
    per_pixel = events_per_pixel(sequence.events, t_us)
    assert per_pixel[-1].item() == pytest.approx(300 / (18 * 20))
    half = sum(int((e.t < 2000).sum()) for e in sequence.events) / (4 * 18 * 20)
    assert per_pixel[2].item() == pytest.approx(half)


def test_frames_of_overlapping_windows_stand_alone_unless_the_state_is_carried(sequence, recoverer):
    times = list(range(2000, 2400, 100))
    alone = sliding_recovery(sequence, 50, times, False, recoverer)
    assert alone.shape == (4, 18, 20)
    torch.testing.assert_close(alone[-1], sliding_recovery(sequence, 50, times[-1:], False, recoverer)[0])
    carried = sliding_recovery(sequence, 50, times, True, recoverer)
    torch.testing.assert_close(carried[0], alone[0])
    assert not torch.equal(carried[-1], alone[-1])


def test_a_growing_window_holds_all_events_so_far(sequence, recoverer):
    windows = [growing_window(sequence.events, t_us) for t_us in (1000, 2000)]
    for window in windows:
        assert (window.start_us, window.stop_us) in ((0, 1000), (0, 2000))
        expected = [int((events.t < window.stop_us).sum()) for events in sequence.events]
        assert list(map(len, window.channels)) == expected
    together = recovered_alone(windows, recoverer)
    torch.testing.assert_close(together[1], recovered_alone(windows[1:], recoverer)[0])
    (last,) = sliding_recovery(sequence, 50, [2000], False, recoverer)
    torch.testing.assert_close(recovered_alone([last_window(sequence.events, 50, 2000)], recoverer)[0], last)


def test_every_frame_falls_into_one_bin_of_events_per_pixel(make_sequence, context):
    sequences = [make_sequence(name, seed=k) for k, name in enumerate("ab")]
    table = since_start(sequences, ["zeros", "oracle_mean"], context)
    assert sum(entry["frames"] for entry in table["zeros"]) == 2 * 4
    for entry in table["zeros"]:
        assert entry["from"] <= entry["events_per_pixel"] <= entry["to"]
    for entry in table["oracle_mean"]:
        assert entry["skill"] == pytest.approx(0, abs=1e-6)


@pytest.fixture
def stored(simulated):
    """Sequences of the small simulation, by name."""
    stores = SceneStore.open(simulated.scenes), EventStore.open(simulated.events)
    return lambda name: StoredSequences(*stores, [name])


def test_windows_twice_as_long_are_half_as_many_with_twice_the_events(stored, context, recoverer):
    assert stored("a-0").scenes.duration_us("a-0") == 200_000
    table = by_window_length(stored("a-0"), [20_000, 40_000], 0, ["zeros", "oracle_mean"], context)
    short, long = table["zeros"]
    assert (short["window_us"], short["frames"]) == (20_000, 10)
    assert (long["window_us"], long["frames"]) == (40_000, 5)
    assert long["events_per_pixel"] == pytest.approx(2 * short["events_per_pixel"], rel=1e-6)
    total = sum(len(channel) for channel in stored("a-0").events.read("a-0")) / (4 * 18 * 24)
    assert 10 * short["events_per_pixel"] == pytest.approx(total, rel=1e-3)  # but for events at time 0


def test_a_window_length_that_leaves_no_window_is_refused(stored, context, recoverer):
    with pytest.raises(ValueError, match="a-0: windows of 150000 us leave none after the first 160000 us of 200000 us"):
        by_window_length(stored("a-0"), [150_000], 160_000, ["zeros"], context)


def test_overlapping_windows_of_more_events_reach_further_back_and_meet_the_same_truth(stored, context, recoverer):
    table = by_sliding_window(stored("a-0"), range(150_000, 152_001, 1_000), recoverer)
    assert [(e["events_per_pixel"], e["carry"]) for e in table] == [
        (size, carry) for size in EVENTS_PER_PIXEL for carry in (False, True)
    ]
    alone, carried = table[::2], table[1::2]
    assert [e["window_ms"] for e in alone] == [e["window_ms"] for e in carried]
    lengths = [e["window_ms"] for e in alone]
    assert lengths == sorted(lengths)
    assert lengths[0] < lengths[-1]
    truth = stored("a-0").sequence("a-0", torch.tensor([149_000, 150_000, 151_000, 152_000])).dolp
    expected = pytest.approx(float(truth.diff(dim=0).abs().mean()), rel=1e-5)
    assert all(e["true_change"] == expected for e in table)


def test_frames_between_windows_are_scored_at_their_own_times(stored, recoverer, project_root):
    config = load(project_root).between
    entry = between_windows(stored("b-0"), range(150_000, 152_001, 1_000), 40_000, recoverer, config)
    times = [150_000, 151_000, 152_000]
    truth = stored("b-0").sequence("b-0", torch.tensor([149_000, *times])).dolp
    run = stored("b-0").sequence("b-0", torch.arange(0, 160_000, 40_000))
    frames = frames_between(run, times, recoverer, config).carried.dolp
    assert entry["mse"] == pytest.approx(float((frames - truth).square().mean()), rel=1e-5)
    assert entry["true_change"] == pytest.approx(float(truth.diff(dim=0).abs().mean()), rel=1e-5)
    assert (entry["window_us"], entry["spacing_us"]) == (40_000, 1_000)
