import pytest
import torch
from method_fixtures import context, make_context, make_sequence, make_setup, sequence

from polarnet.benchmark.rows import opened
from polarnet.methods import METHODS
from studies.event_budget import figure_11, growing_window, last_window, recovered_alone, windows_of_figure_11

__all__ = ["context", "make_context", "make_sequence", "make_setup", "sequence"]


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


def test_figure_11_says_when_and_of_how_many_events_a_pixel(sequence, context):
    windows = windows_of_figure_11(sequence.events, int(sequence.t_us[-1]))["a"]
    pixels = 18 * 20
    counts = [sum(map(len, window.channels)) / 4 for window in windows]
    assert counts == pytest.approx([0.1 * pixels, 0.25 * pixels, 0.5 * pixels], abs=2)  # channels' mean, before t
    figure = figure_11(sequence, windows, recovered_alone(windows, opened(METHODS["ours"], context)))
    titles = [axes.get_title() for axes in figure.axes[: len(windows)]]
    assert titles[-1] == f"t = {windows[-1].stop_us / 1000:.1f} ms, n = {round(counts[-1]):,}"
