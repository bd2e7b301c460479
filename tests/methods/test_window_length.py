import pytest
import torch

from polarnet.events.stream import slice_time
from polarnet.events.streaming import EventWindow, WindowCutter, WindowRule
from polarnet.methods import METHODS
from polarnet.methods.method import Recoverer
from polarnet.methods.overlap import of_any_length
from polarnet.stokes import Prediction

TRAINED_US = 1000


def cut(sequence, length_us):
    first = sequence.events[0]
    cutter = WindowCutter(WindowRule(length_us, None, None), first.height, first.width)
    return list(cutter.add(sequence.events, int(sequence.t_us[-1])))


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


@pytest.fixture
def ours(make_setup):
    return METHODS["ours"].open(make_setup("ours"))


def test_windows_of_the_trained_length_are_used_as_they_are(sequence):
    assert spans_seen(sequence, [1000, 1000]) == [[(0, 1000)], [(1000, 2000)]]
    assert spans_seen(sequence, [700, 1400]) == [[(0, 700)], [(700, 2100)]]


def test_short_windows_are_joined_with_those_before_them(sequence):
    expected = [[(0, 300)], [(0, 600)], [(0, 900)], [(300, 1200)], [(600, 1500)]]
    assert spans_seen(sequence, [300] * 5) == expected


def test_long_windows_are_cut(sequence):
    assert spans_seen(sequence, [2100, 1900]) == [[(0, 1050), (1050, 2100)], [(2100, 3050), (3050, 4000)]]


def test_windows_of_changing_length_keep_about_the_trained_length(sequence):
    assert spans_seen(sequence, [1000, 500, 400, 600])[1:] == [[(1000, 1500)], [(1000, 1900)], [(1500, 2500)]]


def test_every_event_counts_once_in_the_series_that_ends_with_a_window(sequence, ours):
    """Four windows of a quarter: the frames at every whole window are those of whole windows."""
    any_length = of_any_length(ours, TRAINED_US)
    state, quarters = any_length.start(18, 20), []
    for window in cut(sequence, 250):
        state, prediction = any_length.step(state, [window])
        quarters.append(prediction.dolp[0])
    _, whole = ours.step(ours.start(18, 20), cut(sequence, 1000))
    torch.testing.assert_close(torch.stack(quarters[3::4]), whole.dolp, atol=1e-4, rtol=1e-4)


def test_several_windows_at_once_are_windows_one_by_one(sequence, ours):
    any_length = of_any_length(ours, TRAINED_US)
    windows = cut(sequence, 250)
    _, together = any_length.step(any_length.start(18, 20), windows)
    state, frames = any_length.start(18, 20), []
    for window in windows:
        state, prediction = any_length.step(state, [window])
        frames.append(prediction.dolp)
    torch.testing.assert_close(torch.cat(frames), together.dolp)
