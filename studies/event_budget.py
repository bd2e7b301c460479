"""The paper's Fig. 11, how many events DoLP needs, on the test sequences that the pipeline made.

python -m studies.event_budget [--weights FILE]

For a sequence of each test set, DoLP from the events of one window alone, without a state: a window that grows from 0
to t (figure_11a_SET), or one that holds the last 1.04 events per pixel (figure_11b_SET). Events per pixel are the mean
over the four channels, as in the paper.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from polarnet.benchmark.rows import available, opened
from polarnet.benchmark.sequences import TestSequence
from polarnet.config.pipeline import context_of, pipeline_set, set_names
from polarnet.config.tree import load
from polarnet.events.representations import event_tensor
from polarnet.events.stream import Events, slice_count, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.methods import METHODS
from polarnet.methods.method import Recoverer
from polarnet.reports.figures import show_picture, styled, tile_grid
from polarnet.reports.maps import dolp_image, event_full_scale, event_image, write_figure
from studies.study import ROOT

PAPER_EVENTS_PER_PIXEL = 1.04  # at which the paper's recovery is good (section 5)
OUT = Path("outputs", "event_budget")
GROWING = (0.1, 0.25, 0.5, PAPER_EVENTS_PER_PIXEL, 2.0, 4.0)  # events per pixel in the windows of Fig. 11a


def growing_window(channels: Sequence[Events], t_us: int) -> EventWindow:
    """All events before a time, as one window from time 0 (Fig. 11a)."""
    return EventWindow([slice_time(events, 0, t_us) for events in channels], 0, t_us)


def last_window(channels: Sequence[Events], count: int, t_us: int) -> EventWindow:
    """The last `count` events of each channel before a time, as one window from the first of them (Fig. 11b)."""
    stops = [int(torch.searchsorted(events.t, t_us)) for events in channels]
    last = [slice_count(events, max(0, stop - count), stop) for events, stop in zip(channels, stops, strict=True)]
    return EventWindow(last, min((int(events.t[0]) for events in last if len(events)), default=t_us), t_us)


def windows_of_figure_11(events: Sequence[Events], end_us: int) -> dict[str, list[EventWindow]]:
    """Windows of both parts of Fig. 11; empty for a sequence with fewer events than the first needs."""
    pixels, t_us = events[0].height * events[0].width, torch.cat([channel.t for channel in events]).sort().values
    counts = [int(len(events) * pixels * share) for share in GROWING]
    growing = [growing_window(events, int(t_us[n - 1]) + 1) for n in counts if 0 < n <= len(t_us)]
    if not growing:
        return {}
    enough = min(int(len(events) * pixels * PAPER_EVENTS_PER_PIXEL), len(t_us))
    times = torch.linspace(int(t_us[enough - 1]) + 1, end_us, len(GROWING)).long().tolist()
    return {"a": growing, "b": [last_window(events, round(PAPER_EVENTS_PER_PIXEL * pixels), time) for time in times]}


@torch.no_grad()
def recovered_alone(windows: Sequence[EventWindow], recoverer: Recoverer) -> Float[Tensor, "n h w"]:
    """DoLP from each window alone, without a state."""
    first = windows[0].channels[0]
    start = recoverer.start(first.height, first.width)
    return torch.cat([recoverer.step(start, [window])[1].dolp.cpu() for window in windows])


@styled
def figure_11(sequence: TestSequence, windows: Sequence[EventWindow], recovered: Float[Tensor, "n h w"]) -> Figure:
    """Event tensors at 0 degrees, the DoLP recovered from them and the closest true DoLP, a column for each window."""
    figure, grid = tile_grid(3, len(windows), sequence.dolp.shape[1:], bar_row=1)
    for column, window, dolp in zip(grid.T, windows, recovered, strict=True):
        tensor = event_tensor(window.channels[0], window.length_us)
        truth = sequence.dolp[int((sequence.t_us[1:] - window.stop_us).abs().argmin())]
        pictures = event_image(tensor, event_full_scale(tensor)), dolp_image(dolp), dolp_image(truth)
        for axes, picture in zip(column, pictures, strict=True):
            show_picture(axes, picture)
        count = round(sum(map(len, window.channels)) / len(window.channels))
        column[0].set_title(f"t = {window.stop_us / 1000:.1f} ms, n = {count:,}", fontsize=6.5, pad=3)
    for axes, name in zip(grid[:, 0], ("event tensor", "recovered", "truth"), strict=True):
        axes.set_ylabel(name, fontsize=6.5)
    return figure


def main() -> None:
    """Draw a sequence of each test set of the paper."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, help="checkpoint of ours (default: the pipeline's)")
    arguments = parser.parse_args()
    config = load(ROOT)
    context = context_of(config, ["ours"], 0.0, arguments.weights)
    if reason := available(["ours"], context)[1].get("ours"):
        parser.error(f"the event budget needs the DoLP network: {reason}; give --weights FILE")
    OUT.mkdir(parents=True, exist_ok=True)
    recoverer = opened(METHODS["ours"], context)
    for name in {"simulated", "recordings"} & {*set_names(config)}:
        one = pipeline_set(config, name)
        sequence = one.sequence(one.sequences[0])
        for part, windows in windows_of_figure_11(sequence.events, int(sequence.t_us[-1])).items():
            figure = figure_11(sequence, windows, recovered_alone(windows, recoverer))
            write_figure(figure, OUT / f"figure_11{part}_{name}")
    print(f"wrote to {OUT}: {', '.join(sorted(path.name for path in OUT.iterdir()))}")


if __name__ == "__main__":
    main()
