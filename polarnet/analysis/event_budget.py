"""How many events DoLP needs (paper, section 5 and Fig. 11), and how often overlapping windows can recover it.

Three studies run on the test sequences:

- quality against the events per pixel since the start of the motion (Fig. 11a; the paper finds about one);
- quality against the length of the windows;
- frames every fraction of a millisecond (Fig. 11b), from overlapping windows of the last N events of each channel, or
  carried on from window to window (`polarnet.methods.between`).

Events per pixel are the mean over the four channels, as in the paper.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.analysis.between_windows import frames_between
from polarnet.analysis.resimulate import StoredSequences
from polarnet.benchmark.rows import Context, predictions_of
from polarnet.benchmark.score import FrameScore, mean_scores, score_sequence
from polarnet.benchmark.sequences import TestSequence
from polarnet.events.stream import Events, slice_count, slice_time
from polarnet.events.streaming import BIN_EDGES, EventWindow, events_per_pixel
from polarnet.methods.between import BetweenConfig
from polarnet.methods.method import Recoverer
from polarnet.metrics.similarity import correlation, mse, psnr
from polarnet.terminal.progress import ProgressBar

SHOWN = ("mse", "psnr", "ssim", "corr", "skill")
EVENTS_PER_PIXEL = (0.25, 0.5, 1.0, 2.0)
"""Sizes of the overlapping windows, in events per pixel."""


def since_start(sequences: Iterable[TestSequence], methods: Sequence[str], context: Context) -> dict[str, list[dict]]:
    """Frames, scenes and mean scores by method and bin of events per pixel since the start; no window is warm-up.

    Means are taken over frames, then over scenes. Empty bins are left out.
    """
    rows: dict[int, list[FrameScore]] = {}
    rates: dict[int, list[float]] = {}
    for sequence in ProgressBar(list(sequences), "events since the start", unit="sequence"):
        predictions = predictions_of(methods, sequence, context)
        per_pixel = events_per_pixel(sequence.events, sequence.t_us[1:]).tolist()
        for row in score_sequence(sequence, predictions, 0, None, context.device):
            k = int(np.searchsorted(BIN_EDGES, per_pixel[row.window], side="right")) - 1
            rows.setdefault(k, []).append(row)
            rates.setdefault(k, []).append(per_pixel[row.window])
    return {
        method: [
            {
                "from": BIN_EDGES[k],
                "to": BIN_EDGES[k + 1] if math.isfinite(BIN_EDGES[k + 1]) else None,
                "events_per_pixel": float(np.mean(rates[k])),
                **_means(rows[k], method),
            }
            for k in sorted(rows)
        ]
        for method in methods
    }


def by_window_length(
    stored: StoredSequences, lengths_us: Sequence[int], settle_us: int, methods: Sequence[str], context: Context
) -> dict[str, list[dict]]:
    """Mean scores and events per window, by method and window length, over windows that end after `settle_us`.

    The truth is rendered at the end of each window. ValueError if no window of some length ends after `settle_us`.
    """
    table: dict[str, list[dict]] = {method: [] for method in methods}
    for length_us in ProgressBar(lengths_us, "window length", unit="length"):
        rows: list[FrameScore] = []
        per_window: list[float] = []
        for name in stored.names:
            end_us = stored.scenes.duration_us(name)
            t_us = torch.arange(0, end_us + 1, length_us)
            warmup = int((t_us[1:] <= settle_us).sum())
            if len(t_us) < 2 or warmup >= len(t_us) - 1:
                raise ValueError(
                    f"{name}: windows of {length_us} us leave none after the first {settle_us} us of {end_us} us"
                )
            test = stored.sequence(name, t_us)
            predictions = predictions_of(methods, test, context)
            rows += score_sequence(test, predictions, warmup, None, context.device)
            per_window.append(float(events_per_pixel(test.events, t_us).diff().mean()))
        for method in methods:
            entry = {"window_us": length_us, "events_per_pixel": float(np.mean(per_window)), **_means(rows, method)}
            table[method].append(entry)
    return table


def _means(rows: Sequence[FrameScore], method: str) -> dict[str, Any]:
    of_method = [row for row in rows if row.method == method]
    scenes = {row.scene for row in of_method}
    return {"frames": len(of_method), "scenes": len(scenes), **mean_scores(of_method, SHOWN)[method]}


def growing_window(channels: Sequence[Events], t_us: int) -> EventWindow:
    """All events before a time, as one window from time 0 (Fig. 11a)."""
    return EventWindow([slice_time(events, 0, t_us) for events in channels], 0, t_us)


def last_window(channels: Sequence[Events], count: int, t_us: int) -> EventWindow:
    """The last `count` events of each channel before a time, as one window from the first of them (Fig. 11b)."""
    last = _last(channels, count, t_us)
    return EventWindow(last, min((int(events.t[0]) for events in last if len(events)), default=t_us), t_us)


@torch.no_grad()
def recovered_alone(windows: Sequence[EventWindow], recoverer: Recoverer) -> Float[Tensor, "n h w"]:
    """DoLP from each window alone, without a state."""
    first = windows[0].channels[0]
    start = recoverer.start(first.height, first.width)
    return torch.cat([recoverer.step(start, [window])[1].dolp.cpu() for window in windows])


@torch.no_grad()
def sliding_recovery(
    sequence: TestSequence, count: int, t_us: Sequence[int], carry: bool, recoverer: Recoverer
) -> Float[Tensor, "n h w"]:
    """DoLP at times `t_us` from the last `count` events of each channel.

    With `carry`, the method's state passes from one overlapping window to the next; otherwise every window starts
    from the initial state.
    """
    windows = [last_window(sequence.events, count, t) for t in t_us]
    if not carry:
        return recovered_alone(windows, recoverer)
    state, frames = recoverer.start(sequence.events[0].height, sequence.events[0].width), []
    for window in windows:
        state, prediction = recoverer.step(state, [window])
        frames.append(prediction.dolp.cpu())
    return torch.cat(frames)


def _last(channels: Sequence[Events], count: int, t_us: int) -> list[Events]:
    """The last `count` events of each channel before a time."""
    stops = [int(torch.searchsorted(events.t, t_us)) for events in channels]
    return [slice_count(events, max(0, stop - count), stop) for events, stop in zip(channels, stops, strict=True)]


def _length_us(events: Events) -> int:
    """Time from the first event to the last; 0 if there are none."""
    return int(events.t[-1] - events.t[0]) if len(events) else 0


def by_sliding_window(stored: StoredSequences, times_us: range, recoverer: Recoverer) -> list[dict]:
    """Mean scores of frames at evenly spaced times, for each of `EVENTS_PER_PIXEL`, with and without carried state.

    `change` is the mean absolute difference of consecutive frames, and `true_change` is that of the truth; a
    steady method has a small `change`.
    """
    tests = [_truth_at(stored, name, times_us) for name in ProgressBar(stored.names, "truth", unit="sequence")]
    table = []
    for per_pixel in ProgressBar(EVENTS_PER_PIXEL, "overlapping windows", unit="size"):
        for carry in (False, True):
            scores = [_sliding_scores(one, per_pixel, times_us, carry, recoverer) for one in tests]
            table.append(
                {"events_per_pixel": per_pixel, "carry": carry, "spacing_us": times_us.step, **_mean_of(scores)}
            )
    return table


def between_windows(
    stored: StoredSequences, times_us: range, window_us: int, recoverer: Recoverer, config: BetweenConfig
) -> dict[str, Any]:
    """Mean scores, as in `by_sliding_window`, of frames carried on between windows of `window_us`."""
    scores = []
    for name in ProgressBar(stored.names, "frames between windows", unit="sequence"):
        run = stored.sequence(name, torch.arange(0, times_us[-1] + 1, window_us))
        frames = frames_between(run, times_us, recoverer, config).carried.dolp
        scores.append(_frame_scores(frames, _truth_at(stored, name, times_us)))
    return {"window_us": window_us, "spacing_us": times_us.step, **_mean_of(scores)}


def _truth_at(stored: StoredSequences, name: str, times_us: range) -> TestSequence:
    """A sequence whose windows end at these times."""
    return stored.sequence(name, torch.tensor([times_us[0] - times_us.step, *times_us]))


def _mean_of(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([one[name] for one in scores])) for name in scores[0]}


def _sliding_scores(
    sequence: TestSequence, per_pixel: float, times: Sequence[int], carry: bool, recoverer: Recoverer
) -> Mapping[str, float]:
    first = sequence.events[0]
    count = max(2, round(per_pixel * first.height * first.width))
    frames = sliding_recovery(sequence, count, times, carry, recoverer)
    spans = [_length_us(last) for last in _last(sequence.events, count, times[len(times) // 2])]
    return {**_frame_scores(frames, sequence), "window_ms": float(np.mean(spans)) / 1000}


def _frame_scores(frames: Float[Tensor, "n h w"], sequence: TestSequence) -> dict[str, float]:
    """Mean scores of DoLP at the times of a sequence's truth, and its mean change from frame to frame."""
    truth, valid = sequence.dolp, sequence.valid
    scores = {
        "mse": mse(frames, truth, valid),
        "psnr": psnr(frames, truth, valid),
        "corr": correlation(frames, truth, valid),
    }
    return {
        **{name: float(values.mean()) for name, values in scores.items()},
        "change": float(frames.diff(dim=0).abs().mean()),
        "true_change": float(truth.diff(dim=0).abs().mean()),
    }
