import pytest
import torch

from polarnet.evaluation.event_budget import events_per_pixel, since_start, sliding_recovery


def test_events_per_pixel_is_the_mean_over_polarizers_of_what_has_come(sequence):
    t_us = sequence.t_us
    found = events_per_pixel(sequence.events, t_us)
    assert found[-1].item() == pytest.approx(300 / (18 * 20))
    half = sum(int((e.t <= 2000).sum()) for e in sequence.events) / (4 * 18 * 20)
    assert found[2].item() == pytest.approx(half)


def test_frames_of_overlapping_windows_stand_alone_unless_the_state_is_carried(sequence, context):
    times = list(range(2000, 2400, 100))
    alone = sliding_recovery(sequence, 50, times, False, "ours", context)
    assert alone.shape == (4, 18, 20)
    torch.testing.assert_close(alone[-1], sliding_recovery(sequence, 50, times[-1:], False, "ours", context)[0])
    carried = sliding_recovery(sequence, 50, times, True, "ours", context)
    torch.testing.assert_close(carried[0], alone[0])
    assert not torch.equal(carried[-1], alone[-1])


def test_every_frame_falls_into_one_bin_of_events_per_pixel(make_sequence, context):
    sequences = [make_sequence(name, seed=k) for k, name in enumerate("ab")]
    table = since_start(sequences, ["zeros", "oracle_mean"], context)
    assert sum(entry["frames"] for entry in table["zeros"]) == 2 * 4
    for entry in table["zeros"]:
        assert entry["from"] <= entry["events_per_pixel"] <= entry["to"]
    for entry in table["oracle_mean"]:
        assert entry["skill"] == pytest.approx(0, abs=1e-6)
