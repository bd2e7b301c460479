import pytest
import torch

from polarnet.evaluation.event_budget import SlidingEventTensor, events_per_pixel, since_start, sliding_recovery
from polarnet.events.representations import event_tensor
from polarnet.events.stream import Events, slice_count


def test_events_per_pixel_is_the_mean_over_polarizers_of_what_has_come(recording):
    t_us = recording.t_us
    found = events_per_pixel(recording.events, t_us)
    assert found[-1].item() == pytest.approx(300 / (18 * 20))
    half = sum(int((e.t <= 2000).sum()) for e in recording.events) / (4 * 18 * 20)
    assert found[2].item() == pytest.approx(half)


@pytest.mark.parametrize("count", [2, 17, 100, 1000])
def test_the_tensor_kept_up_to_date_is_that_of_the_window_cut_out_anew(recording, count):
    events = recording.events[0]
    sliding = SlidingEventTensor(events, count)
    for t_us in (0, 3, 700, 701, 1900, 4000, 4000):
        sliding.advance(t_us)
        stop = int((events.t < t_us).sum())
        window = slice_count(events, max(0, stop - count), stop)
        if len(window) < 2:
            assert not sliding.tensor().any()
            continue
        length_us = max(1, int(window.t[-1] - window.t[0]))
        torch.testing.assert_close(sliding.tensor(), event_tensor(window, length_us), atol=1e-5, rtol=1e-5)


def test_an_event_that_comes_and_goes_leaves_nothing(recording):
    events = recording.events[0]
    sliding = SlidingEventTensor(events, 5)
    for t_us in range(0, 4001, 7):
        sliding.advance(t_us)
    anew = SlidingEventTensor(events, 5)
    anew.advance(int(events.t[-1]) + 1)
    sliding.advance(int(events.t[-1]) + 1)
    assert torch.equal(sliding.tensor(), anew.tensor())


def test_a_step_touches_the_events_of_the_step_alone(recording, monkeypatch):
    sliding = SlidingEventTensor(recording.events[0], 100)
    sliding.advance(2000)
    touched = []
    add = sliding._add
    monkeypatch.setattr(
        sliding, "_add", lambda first, stop, sign: touched.append(stop - first) or add(first, stop, sign)
    )
    before = sliding.stop
    sliding.advance(2050)
    came = sliding.stop - before
    assert came < 20
    assert sorted(touched) == [came, came]  # as many go as come


def test_time_only_goes_forward(recording):
    sliding = SlidingEventTensor(recording.events[0], 5)
    sliding.advance(1000)
    with pytest.raises(ValueError, match="time only goes forward"):
        sliding.advance(500)
    with pytest.raises(ValueError, match="at least 2 events"):
        SlidingEventTensor(recording.events[0], 1)


def test_before_any_event_there_is_nothing_to_see(context):
    still = SlidingEventTensor(Events.empty(18, 20), 9)
    still.advance(1000)
    assert not still.tensor().any()


def test_frames_of_overlapping_windows_stand_alone_unless_the_state_is_carried(recording, context):
    network, _ = context.ours
    times = list(range(2000, 2400, 100))
    alone = sliding_recovery(recording, network, 50, times, False, context)
    assert alone.shape == (4, 18, 20)
    torch.testing.assert_close(alone[-1], sliding_recovery(recording, network, 50, times[-1:], False, context)[0])
    carried = sliding_recovery(recording, network, 50, times, True, context)
    torch.testing.assert_close(carried[0], alone[0])
    assert not torch.equal(carried[-1], alone[-1])


def test_every_frame_falls_into_one_bin_of_events_per_pixel(make_recording, context):
    recordings = [make_recording(name, seed=k) for k, name in enumerate("ab")]
    table = since_start(recordings, ["zeros", "oracle_mean"], context)
    assert sum(entry["frames"] for entry in table["zeros"]) == 2 * 4
    for entry in table["zeros"]:
        assert entry["from"] <= entry["events_per_pixel"] <= entry["to"]
    for entry in table["oracle_mean"]:
        assert entry["skill"] == pytest.approx(0, abs=1e-6)
