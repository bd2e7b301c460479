import pytest
import torch

from polarnet.evaluation.methods import METHODS, recover
from polarnet.evaluation.recoverer import STREAMED, Recoverer, StateHistory, stream_of
from polarnet.events.stream import slice_time
from polarnet.events.streaming import EventWindow, WindowCutter, WindowRule
from polarnet.events.windows import cut_windows
from polarnet.networks.blocks import Prediction
from polarnet.networks.checkpoint import load_network

WINDOW_US = 1000
CONSECUTIVE = WindowRule(WINDOW_US, None, None)


def windows_of(recording, rule=CONSECUTIVE):
    first = recording.events[0]
    cutter = WindowCutter(rule, first.height, first.width)
    return list(cutter.add(recording.events, int(recording.t_us[-1])))


@pytest.fixture
def with_boundary_events(recording):
    """One event of each channel exactly at each frame, the last frame included."""
    for events in recording.events:
        for frame_us in recording.t_us[1:-1].tolist():
            events.t[torch.searchsorted(events.t, frame_us)] = frame_us
        events.t[-1] = recording.t_us[-1]
    return recording


def test_an_event_at_a_windows_end_belongs_to_the_next_window_in_batches_and_streams_alike(with_boundary_events):
    streamed = windows_of(with_boundary_events)
    for channel, events in enumerate(with_boundary_events.events):
        batch = cut_windows(events, with_boundary_events.t_us)
        assert [len(window) for window in batch] == [len(window.channels[channel]) for window in streamed]
        assert [int(window.t[0]) for window in batch[1:]] == [1000, 2000, 3000]
        assert sum(map(len, batch)) == len(events) - 1  # the event at the last frame has no window


def test_all_methods_but_the_constants_are_streams():
    assert set(STREAMED) == set(METHODS) - {"zeros", "train_mean", "oracle_mean"}


@pytest.mark.parametrize("method", STREAMED)
def test_a_stream_gives_what_the_method_gives_for_the_whole_recording(method, with_boundary_events, context):
    stream = stream_of(method, context)
    expected = recover(method, with_boundary_events, context)
    found = [stream.step(window) for window in windows_of(with_boundary_events)]
    assert stream.windows == len(found) == 4
    torch.testing.assert_close(torch.stack([one.dolp for one in found]), expected.dolp, atol=2e-5, rtol=1e-4)
    if expected.aolp is None:
        assert found[0].aolp is None
    else:
        angle = torch.stack([one.aolp for one in found]) - expected.aolp
        assert (torch.sin(angle).abs() * expected.dolp).max() < 1e-3  # of period pi, and undefined without polarization
    stream.reset()
    torch.testing.assert_close(stream.step(windows_of(with_boundary_events)[0]).dolp, found[0].dolp)


@pytest.mark.parametrize("network", ["ours_checkpoint", "paper_checkpoint"])
def test_windows_at_once_give_what_they_give_one_by_one(network, with_boundary_events, checkpoints):
    windows = windows_of(with_boundary_events)
    one_by_one, together = Recoverer(load_network(checkpoints[network])), Recoverer(load_network(checkpoints[network]))
    expected = [one_by_one.step(window) for window in windows]
    found = [*together.step_on(windows[:3]), together.step(windows[3])]
    assert together.windows == 4
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.dolp, other.dolp, atol=1e-5, rtol=1e-4)


def test_windows_at_once_must_follow_each_other(with_boundary_events, checkpoints):
    windows = windows_of(with_boundary_events)
    with pytest.raises(ValueError, match=r"follow each other, got \[\(0, 1000\), \(2000, 3000\)\] us"):
        Recoverer(load_network(checkpoints["ours_checkpoint"])).step_on([windows[0], windows[2]])


def test_many_streams_at_once_give_what_each_gives_alone(make_recording, checkpoints):
    network = load_network(checkpoints["ours_checkpoint"])
    recordings = [windows_of(make_recording(seed=seed)) for seed in range(3)]
    together, alone = Recoverer(network), Recoverer(network)
    together.prepare(18, 20, streams=3)
    batches = [together.step_many(windows).dolp for windows in zip(*recordings, strict=True)]
    for k, windows in enumerate(recordings):
        alone.reset()
        for window, batch in zip(windows, batches, strict=True):
            torch.testing.assert_close(alone.step(window).dolp, batch[k], atol=1e-5, rtol=1e-4)
    with pytest.raises(ValueError, match=r"until reset\(\), of 3 streams, got 2"):
        together.step_many([recordings[0][0]] * 2)
    with pytest.raises(ValueError, match="expected windows of one time"):
        alone.step_many(recordings[0][:2])


def test_overlapping_windows_continue_those_that_ended_where_they_begin(recording, context):
    """Every quarter of a window: the fourth part of the frames is what windows one after the other give."""
    overlapping = stream_of("ours", context)
    frames = {w.stop_us: overlapping.step(w).dolp for w in windows_of(recording, WindowRule(WINDOW_US, None, 250))}
    for shift_us in (0, 250, 500, 750):
        events = [slice_time(one, shift_us, 10**6) for one in recording.events]
        alone = stream_of("ours", context)
        for stop_us in range(shift_us + WINDOW_US, 4001, WINDOW_US):
            channels = [slice_time(one, stop_us - WINDOW_US, stop_us) for one in events]
            first = [int((one.t < stop_us - WINDOW_US).sum()) for one in events]
            expected = alone.step(EventWindow(channels, stop_us - WINDOW_US, stop_us, first)).dolp
            torch.testing.assert_close(frames[stop_us], expected, atol=1e-5, rtol=1e-4)


def test_a_bounded_number_of_states_is_kept_however_fine_the_steps():
    history, length = StateHistory(), 33_300
    for stop in range(length, 20 * length, 100):
        window = EventWindow([], stop - length, stop, [])
        state = history.before(window)
        assert (state is None) == (stop < 2 * length)
        if state is not None:
            assert 0 <= window.start_us - state < length / 64 + 100
        history.after(window, stop)
    assert len(history._left) <= 66


def test_more_than_dolp_is_handed_on_where_the_network_says_more(recording):
    class Sure(torch.nn.Module):
        def forward(self, inputs, state):
            maps = inputs[:, 0]
            return Prediction(3 + maps, 0.5 + 0 * maps, maps), [maps]

    found = Recoverer((Sure(), {"representation": "voxel_grid"})).step(windows_of(recording)[0])
    assert found.dolp.max() <= 1
    assert found.aolp.unique().tolist() == [0.5]
    assert found.log_variance.shape == (18, 20)


def test_a_constant_is_no_stream(context):
    with pytest.raises(ValueError, match="expected a method of cf, "):
        stream_of("oracle_mean", context)
