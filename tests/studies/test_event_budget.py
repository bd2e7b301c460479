import pytest
import torch
from method_fixtures import context, make_context, make_sequence, make_setup, sequence

from polarnet.benchmark.rows import opened
from polarnet.methods import METHODS
from polarnet.reports.maps import png
from studies.event_budget import (
    budget_figure,
    events_per_pixel,
    figure_11,
    growing_window,
    last_window,
    recovered_alone,
    since_start,
    windows_of_figure_11,
)

__all__ = ["context", "make_context", "make_sequence", "make_setup", "sequence"]


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
    rates = [entry["events_per_pixel"] for entry in table["zeros"]]
    assert sum(entry["frames"] for entry in table["zeros"]) == 2 * 4
    assert rates == sorted(rates) == [entry["events_per_pixel"] for entry in table["oracle_mean"]]
    assert all(entry["corr"] == 0 for entry in table["oracle_mean"])
    figure = budget_figure(table)
    assert any(line.get_linestyle() == "--" and line.get_xdata()[0] == 1.04 for line in figure.axes[0].lines)
    assert png(figure) == png(budget_figure(table))


def test_figure_11_says_when_and_of_how_many_events(sequence, context):
    windows = windows_of_figure_11(sequence.events, int(sequence.t_us[-1]))["a"]
    figure = figure_11(sequence, windows, recovered_alone(windows, opened(METHODS["ours"], context)))
    last = windows[-1]
    count = round(sum(map(len, last.channels)) / 4)
    assert figure.axes[len(windows) - 1].get_title() == f"t = {last.stop_us / 1000:.1f} ms, n = {count:,}"
