"""How many events DoLP needs (paper, section 5 and Fig. 11), on the test sequences that the pipeline made.

python -m studies.event_budget [--methods NAME ...] [--weights FILE] [--out FOLDER]

Writes event_budget.json and event_budget.png, quality against the events per pixel since the start of the motion (the
paper finds that about one suffices), and, for a sequence of each set, Fig. 11: DoLP from the events of one window
alone, which grows from 0 to t (figure_11a_SET), or holds the last 1.04 events per pixel (figure_11b_SET). Events per
pixel are the mean over the four channels, as in the paper.
"""

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from matplotlib.figure import Figure
from torch import Tensor

from polarnet.benchmark.rows import Context, available, opened, predictions_of
from polarnet.benchmark.score import FrameScore, scene_means, score_sequence
from polarnet.benchmark.sequences import TestSequence, train_mean_dolp
from polarnet.config.pipeline import context_of, pipeline_set, set_names
from polarnet.config.tree import load
from polarnet.events.representations import event_tensor
from polarnet.events.stream import Events, slice_count, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.methods import METHODS
from polarnet.methods.method import Recoverer
from polarnet.reports.figures import LIGHT, show_picture, styled, tile_grid
from polarnet.reports.legend import GENERAL
from polarnet.reports.maps import dolp_image, event_full_scale, event_image, png, write_figure
from polarnet.terminal.progress import ProgressBar
from studies.study import ROOT

BIN_EDGES = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 13.0, 20.0, np.inf)
PAPER_EVENTS_PER_PIXEL = 1.04  # at which the paper's recovery is good (section 5)
GROWING = (0.1, 0.25, 0.5, PAPER_EVENTS_PER_PIXEL, 2.0, 4.0)  # events per pixel in the windows of Fig. 11a


def events_per_pixel(events: Sequence[Events], t_us: Int64[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Mean number of events per pixel before each time (t < time), averaged over the channels."""
    counts = torch.stack([torch.searchsorted(e.t, t_us) for e in events]).double().mean(dim=0)
    return (counts / (events[0].height * events[0].width)).float()


def since_start(sequences: Iterable[TestSequence], methods: Sequence[str], context: Context) -> dict[str, list[dict]]:
    """Number of frames and mean PSNR and correlation by method and bin of events per pixel; no window is warm-up."""
    bins: dict[int, list[tuple[float, FrameScore]]] = {}
    for sequence in ProgressBar(list(sequences), "events since the start", unit="sequence"):
        predictions = predictions_of(methods, sequence, context)
        per_pixel = events_per_pixel(sequence.events, sequence.t_us[1:]).tolist()
        for row in score_sequence(sequence, predictions, 0, None, context.device):
            k = int(np.searchsorted(BIN_EDGES, per_pixel[row.window], side="right")) - 1
            bins.setdefault(k, []).append((per_pixel[row.window], row))
    table: dict[str, list[dict]] = {method: [] for method in methods}
    for _, found in sorted(bins.items()):
        means = {metric: scene_means([row for _, row in found], metric) for metric in ("psnr", "corr")}
        rate, frames = float(np.mean([rate for rate, _ in found])), len(found) // len(methods)
        for method in methods:
            scores = {metric: float(np.mean([*of[method].values()])) for metric, of in means.items()}
            table[method].append({"events_per_pixel": rate, "frames": frames, **scores})
    return table


def growing_window(channels: Sequence[Events], t_us: int) -> EventWindow:
    """All events before a time, as one window from time 0 (Fig. 11a)."""
    return EventWindow([slice_time(events, 0, t_us) for events in channels], 0, t_us)


def last_window(channels: Sequence[Events], count: int, t_us: int) -> EventWindow:
    """The last `count` events of each channel before a time, as one window from the first of them (Fig. 11b)."""
    stops = [int(torch.searchsorted(events.t, t_us)) for events in channels]
    last = [slice_count(events, max(0, stop - count), stop) for events, stop in zip(channels, stops, strict=True)]
    return EventWindow(last, min((int(events.t[0]) for events in last if len(events)), default=t_us), t_us)


@torch.no_grad()
def recovered_alone(windows: Sequence[EventWindow], recoverer: Recoverer) -> Float[Tensor, "n h w"]:
    """DoLP from each window alone, without a state."""
    first = windows[0].channels[0]
    start = recoverer.start(first.height, first.width)
    return torch.cat([recoverer.step(start, [window])[1].dolp.cpu() for window in windows])


@styled(LIGHT)
def budget_figure(table: dict[str, list[dict]]) -> Figure:
    """PSNR (dB) and correlation of DoLP against events per pixel; a dashed line is the paper's 1.04."""
    figure = Figure(figsize=(7.0, 3.0), layout="constrained", facecolor=LIGHT.face)
    for axes, metric, label in zip(figure.subplots(1, 2), ("psnr", "corr"), ("PSNR, dB", "correlation"), strict=True):
        for method, bins in table.items():
            places, values = zip(*((one["events_per_pixel"], one[metric]) for one in bins), strict=True)
            axes.plot(places, values, "o-", color=GENERAL.colour(method), label=GENERAL.label(method))
        axes.axvline(PAPER_EVENTS_PER_PIXEL, color=LIGHT.quiet, linewidth=0.9, linestyle="--")
        axes.set(xscale="log", xlabel="events per pixel since the start", ylabel=label)
    figure.axes[0].legend()
    return figure


@styled(LIGHT)
def figure_11(sequence: TestSequence, windows: Sequence[EventWindow], recovered: Float[Tensor, "n h w"]) -> Figure:
    """Event tensors at 0 degrees, the DoLP recovered from them and the closest true DoLP, a column for each window."""
    figure, grid = tile_grid(3, len(windows), sequence.dolp.shape[1:], bar_row=1)
    for column, window, dolp in zip(grid.T, windows, recovered, strict=True):
        tensor = event_tensor(window.channels[0], window.length_us)
        truth = sequence.dolp[int((sequence.t_us[1:] - window.stop_us).abs().argmin())]
        pictures = event_image(tensor, event_full_scale(tensor)), dolp_image(dolp), dolp_image(truth)
        for axes, picture in zip(column, pictures, strict=True):
            show_picture(axes, picture, LIGHT)
        count = round(sum(map(len, window.channels)) / len(window.channels))
        column[0].set_title(f"t = {window.stop_us / 1000:.1f} ms, n = {count:,}", fontsize=6.5, pad=3)
    for axes, name in zip(grid[:, 0], ("event tensor", "recovered", "truth"), strict=True):
        axes.set_ylabel(name, fontsize=6.5)
    return figure


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


def main() -> None:
    """Score the methods on the simulated test sequences, and draw one of each set of the paper."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", default=["oracle_mean", "cf", "highpass", "ours"])
    parser.add_argument("--weights", type=Path, help="checkpoint of ours (default: the pipeline's)")
    parser.add_argument("--out", type=Path, default=Path("outputs", "event_budget"))
    arguments = parser.parse_args()
    config = load(ROOT)
    tests = pipeline_set(config, "simulated")
    mean = train_mean_dolp(tests.frames, config.benchmark.warmup_windows)
    context = context_of(config, [*arguments.methods, "ours"], mean, arguments.weights)
    _, left_out = available(["ours"], context)
    if left_out:
        parser.error(f"the event budget needs the DoLP network: {left_out['ours']}; give --weights FILE")
    results: dict[str, Any] = {"sequences": list(tests.sequences)}
    sequences = (tests.sequence(name) for name in tests.sequences)
    results["since_start"] = since_start(sequences, arguments.methods, context)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "event_budget.json").write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    (arguments.out / "event_budget.png").write_bytes(png(budget_figure(results["since_start"])))
    recoverer = opened(METHODS["ours"], context)
    for name in {"simulated", "recordings"} & {*set_names(config)}:
        one = pipeline_set(config, name)
        sequence = one.sequence(one.sequences[0])
        for part, windows in windows_of_figure_11(sequence.events, int(sequence.t_us[-1])).items():
            figure = figure_11(sequence, windows, recovered_alone(windows, recoverer))
            write_figure(figure, arguments.out / f"figure_11{part}_{name}")
    print(f"wrote to {arguments.out}: {', '.join(sorted(path.name for path in arguments.out.iterdir()))}")


if __name__ == "__main__":
    main()
