import pytest
import torch

from polarnet.events.stream import slice_time
from polarnet.events.streaming import EventWindow, WindowCutter, WindowRule, join_windows
from polarnet.methods import METHODS
from polarnet.methods.method import Recoverer
from polarnet.methods.overlap import advance, begin, of_any_length, warm_up
from polarnet.stokes import Prediction

WINDOW_US = 1000


def windows_of(sequence, rule):
    first = sequence.events[0]
    cutter = WindowCutter(rule, first.height, first.width)
    return list(cutter.add(sequence.events, int(sequence.t_us[-1])))


@pytest.fixture
def ours(make_setup):
    return METHODS["ours"].open(make_setup("ours"))


def test_windows_at_once_must_follow_each_other_and_joined_ones_hold_each_event_once(sequence, ours):
    windows = sequence.windows()
    with pytest.raises(ValueError, match=r"follow each other, got \[\(0, 1000\), \(2000, 3000\)\] us"):
        advance(ours, begin(ours, 18, 20), [windows[0], windows[2]])
    overlapping = windows_of(sequence, WindowRule(WINDOW_US, 500))
    joined = join_windows(overlapping)
    assert (joined.start_us, joined.stop_us, joined.joined) == (0, overlapping[-1].stop_us, len(overlapping))
    for channel, events in zip(joined.channels, sequence.events, strict=True):
        assert torch.equal(channel.t, slice_time(events, 0, joined.stop_us).t)
    any_length = of_any_length(ours, TRAINED_US)
    _, one_step = ours.step(ours.start(18, 20), [joined])
    torch.testing.assert_close(any_length.step(any_length.start(18, 20), [joined])[1].dolp, one_step.dolp)


def test_overlapping_windows_continue_those_that_ended_where_they_begin(sequence, ours):
    """Every quarter of a window: the fourth part of the frames is what windows one after the other give."""
    history, frames = begin(ours, 18, 20), {}
    for window in windows_of(sequence, WindowRule(WINDOW_US, 250)):
        history, prediction = advance(ours, history, [window])
        frames[window.stop_us] = prediction.dolp
    for shift_us in (0, 250, 500, 750):
        state = ours.start(18, 20)
        for stop_us in range(shift_us + WINDOW_US, 4001, WINDOW_US):
            channels = [slice_time(one, stop_us - WINDOW_US, stop_us) for one in sequence.events]
            state, expected = ours.step(state, [EventWindow(channels, stop_us - WINDOW_US, stop_us)])
            torch.testing.assert_close(frames[stop_us], expected.dolp, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ["cf", "highpass"])
@pytest.mark.parametrize("step_us", [250, 300])
def test_a_filter_counts_each_event_once_however_windows_overlap(name, step_us, sequence, make_setup):
    recoverer = METHODS[name].open(make_setup(name))
    last = []
    for rule in (WindowRule(WINDOW_US, None), WindowRule(WINDOW_US, step_us)):
        history, prediction = begin(recoverer, 18, 20), None
        for window in windows_of(sequence, rule):
            history, prediction = advance(recoverer, history, [window])
        last.append(prediction.intensities)
        warm_up(recoverer, 18, 20)  # leaves no trace
    torch.testing.assert_close(*last)


def test_a_bounded_number_of_states_is_kept_however_fine_the_steps():
    """A method whose state is the end of the last window that it saw."""
    length, begun = 33_300, []

    def predict(state, windows):
        begun.append(state)
        return windows[-1].stop_us, Prediction(torch.zeros(1, 1, 1))

    recoverer = Recoverer(lambda height, width: None, predict)
    history = begin(recoverer, 1, 1)
    for stop in range(length, 20 * length, 100):
        history, _ = advance(recoverer, history, [EventWindow([], stop - length, stop)])
        assert (begun[-1] is None) == (stop < 2 * length)
        if begun[-1] is not None:
            assert 0 <= stop - length - begun[-1] < length / 64 + 100
    assert len(history) <= 67


TRAINED_US = 1000


def spans_seen(sequence, lengths_us):
    """The windows that a method trained on TRAINED_US sees, given windows of these lengths one by one."""
    runs = []

    def predict(state, windows):
        runs.append([(window.start_us, window.stop_us) for window in windows])
        return None, Prediction(torch.zeros(len(windows), 18, 20))

    recoverer = of_any_length(Recoverer(lambda height, width: None, predict), TRAINED_US)
    state, start = recoverer.start(18, 20), 0
    for length in lengths_us:
        channels = [slice_time(events, start, start + length) for events in sequence.events]
        state, prediction = recoverer.step(state, [EventWindow(channels, start, start + length)])
        assert len(prediction.dolp) == 1
        start += length
    return runs


@pytest.mark.parametrize(
    ("lengths_us", "spans"),
    [
        ([1000, 1000], [[(0, 1000)], [(1000, 2000)]]),
        ([700, 1400], [[(0, 700)], [(700, 2100)]]),
        ([300] * 5, [[(0, 300)], [(0, 600)], [(0, 900)], [(300, 1200)], [(600, 1500)]]),
        ([2100, 1900], [[(0, 1050), (1050, 2100)], [(2100, 3050), (3050, 4000)]]),
        ([1000, 500, 400, 600], [[(0, 1000)], [(1000, 1500)], [(1000, 1900)], [(1500, 2500)]]),
    ],
)
def test_short_windows_are_joined_long_ones_cut_and_those_of_about_the_trained_length_used(sequence, lengths_us, spans):
    assert spans_seen(sequence, lengths_us) == spans


def test_every_event_counts_once_in_the_series_that_ends_with_a_window_and_windows_may_come_at_once(sequence, ours):
    """Four windows of a quarter: the frames at every whole window are those of whole windows."""
    any_length, quarters = of_any_length(ours, TRAINED_US), windows_of(sequence, WindowRule(250, None))
    _, together = any_length.step(any_length.start(18, 20), quarters)
    state, frames = any_length.start(18, 20), []
    for window in quarters:
        state, prediction = any_length.step(state, [window])
        frames.append(prediction.dolp)
    torch.testing.assert_close(torch.cat(frames), together.dolp)
    _, whole = ours.step(ours.start(18, 20), sequence.windows())
    torch.testing.assert_close(together.dolp[3::4], whole.dolp, atol=1e-4, rtol=1e-4)
