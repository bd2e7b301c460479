"""How many events DoLP needs (paper, section 5 and Fig. 11), and how often it can be recovered from overlapping events.

Three questions, each on the test sequences:

- since the start of the motion: quality against the events per pixel that have come so far (Fig. 11a; the paper's
  answer is about one);
- the length of the windows that the events are cut into;
- windows of the last N events of each polarizer, recovered every fraction of a millisecond (Fig. 11b).

Events per pixel are the mean over the four polarizers, as in the paper.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor
from tqdm import tqdm

from polarnet.evaluation.methods import Context, Polarization, Recording, degree, recover
from polarnet.evaluation.resimulate import recording_at
from polarnet.evaluation.score import FrameScore, scene_means, score_sequence
from polarnet.events.representations import REPRESENTATIONS, event_tensor
from polarnet.events.store import EventStore
from polarnet.events.stream import Events, slice_count
from polarnet.events.streaming import SlidingEventTensor
from polarnet.similarity import correlation, mse, psnr
from polarnet.simulation.scenes import SceneStore

BIN_EDGES = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 13.0, 20.0, math.inf)
"""Of events per pixel since the start; finer below 2, where the paper sees the change."""
SHOWN = ("mse", "psnr", "ssim", "corr", "skill")
EVENTS_PER_PIXEL = (0.25, 0.5, 1.0, 2.0)
"""Sizes of the overlapping windows."""


def events_per_pixel(events: Sequence[Events], t_us: Int64[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Mean number of events per pixel and channel before each time (t < time)."""
    counts = torch.stack([torch.searchsorted(e.t, t_us) for e in events]).double().mean(dim=0)
    return (counts / (events[0].height * events[0].width)).float()


def since_start(recordings: Iterable[Recording], methods: Sequence[str], context: Context) -> dict[str, list[dict]]:
    """Method, then bin of events per pixel since the start: frames, scenes and mean scores; no window is warm-up.

    A bin's means are over frames, then scenes; bins that no frame falls into are left out.
    """
    rows: dict[int, list[FrameScore]] = {}
    rates: dict[int, list[float]] = {}
    for recording in tqdm(list(recordings), "events since the start", unit="sequence"):
        answers = {method: _answer(method, recording, context) for method in methods}
        per_pixel = events_per_pixel(recording.events, recording.t_us[1:]).tolist()
        for row in score_sequence(recording, answers, 0, None, context.device):
            k = int(np.searchsorted(BIN_EDGES, per_pixel[row.window], side="right")) - 1
            rows.setdefault(k, []).append(row)
            rates.setdefault(k, []).append(per_pixel[row.window])
    return {
        method: [
            {
                "from": BIN_EDGES[k],
                "to": BIN_EDGES[k + 1] if math.isfinite(BIN_EDGES[k + 1]) else None,
                "events_per_pixel": float(np.mean(rates[k])),
                **_means([row for row in rows[k] if row.method == method]),
            }
            for k in sorted(rows)
        ]
        for method in methods
    }


def by_window_length(
    scenes: SceneStore,
    events: EventStore,
    sequences: Sequence[str],
    lengths_us: Sequence[int],
    settle_us: int,
    methods: Sequence[str],
    context: Context,
) -> dict[str, list[dict]]:
    """Method, then window length: mean scores of the windows that end later than `settle_us`, and events per window.

    The truth is rendered at each window's own end. ValueError where no window of a length ends after `settle_us`.
    """
    table: dict[str, list[dict]] = {method: [] for method in methods}
    for length_us in tqdm(lengths_us, "window length", unit="length"):
        rows: list[FrameScore] = []
        per_window: list[float] = []
        for sequence in sequences:
            end_us = scenes.duration_us(sequence)
            t_us = torch.arange(0, end_us + 1, length_us)
            warmup = int((t_us[1:] <= settle_us).sum())
            if len(t_us) < 2 or warmup >= len(t_us) - 1:
                raise ValueError(
                    f"{sequence}: windows of {length_us} us leave none after the first {settle_us} us of {end_us} us"
                )
            recording = recording_at(scenes, sequence, events.read(sequence), t_us)
            answers = {method: _answer(method, recording, context) for method in methods}
            rows += score_sequence(recording, answers, warmup, None, context.device)
            per_window.append(float(events_per_pixel(recording.events, t_us).diff().mean()))
        for method in methods:
            of_method = [row for row in rows if row.method == method]
            entry = {"window_us": length_us, "events_per_pixel": float(np.mean(per_window)), **_means(of_method)}
            table[method].append(entry)
    return table


def _answer(method: str, recording: Recording, context: Context) -> Polarization:
    return recover(method, recording, context).polarization


def _means(rows: Sequence[FrameScore]) -> dict[str, Any]:
    means = {metric: scene_means(rows, metric) for metric in SHOWN}
    scores = {metric: float(np.mean([*next(iter(of.values())).values()])) for metric, of in means.items() if of}
    return {"frames": len(rows), "scenes": len({row.scene for row in rows}), **scores}


def move_to_last(sliding: SlidingEventTensor, events: Events, count: int, t_us: int) -> Float[Tensor, "h w"]:
    """The event tensor of the last `count` of the events before `t_us`; time only goes forward.

    The window ends with its last event; 0 everywhere while fewer than two events have come.
    """
    stop = int(torch.searchsorted(events.t, t_us))
    first = max(0, stop - count)
    sliding.move_to(first, slice_count(events, first, stop))
    times = sliding.window.t
    return sliding.tensor(max(1, int(times[-1] - times[0])) if len(times) else 1)


@torch.no_grad()
def sliding_recovery(
    recording: Recording, count: int, t_us: Sequence[int], carry: bool, context: Context
) -> Float[Tensor, "n h w"]:
    """DoLP at times `t_us` from the last `count` events of each polarizer, by the network `ours`.

    Event tensors are updated as the window moves, other input is encoded anew. `carry`: whether the network's state
    goes from one overlapping window to the next, or each stands alone.
    """
    network, metadata = context.ours
    encode = REPRESENTATIONS[metadata["representation"]]
    windows = [SlidingEventTensor(events.height, events.width) for events in recording.events]
    state, frames = None, []
    for t in t_us:
        if encode is event_tensor:
            images = [move_to_last(w, events, count, t) for w, events in zip(windows, recording.events, strict=True)]
        else:
            images = [encode(last, max(1, _length_us(last))) for last in _last(recording.events, count, t)]
        inputs = torch.cat([image.view(-1, *image.shape[-2:]) for image in images])[None].to(context.device)
        with context.autocast():
            prediction, after = network(inputs, state)
        state = after if carry else None
        frames.append(degree(prediction.dolp[0]).cpu())
    return torch.stack(frames)


def _last(channels: Sequence[Events], count: int, t_us: int) -> list[Events]:
    """The last `count` events of each channel before a time."""
    stops = [int(torch.searchsorted(events.t, t_us)) for events in channels]
    return [slice_count(events, max(0, stop - count), stop) for events, stop in zip(channels, stops, strict=True)]


def _length_us(events: Events) -> int:
    """From the first event to the last; 0 where there are none."""
    return int(events.t[-1] - events.t[0]) if len(events) else 0


def by_sliding_window(
    scenes: SceneStore,
    events: EventStore,
    sequences: Sequence[str],
    span_us: tuple[int, int],
    spacing_us: int,
    context: Context,
) -> list[dict]:
    """For each of `EVENTS_PER_PIXEL`, with the state carried on and without: mean scores of a frame every `spacing_us`.

    `change` is the mean absolute difference of consecutive frames, which of a steady recovery is small, beside that
    of the truth.
    """
    times = list(range(span_us[0], span_us[1] + 1, spacing_us))
    table = []
    recordings = [
        recording_at(scenes, name, events.read(name), torch.tensor([times[0] - spacing_us, *times]))
        for name in tqdm(sequences, "truth", unit="sequence")
    ]
    for per_pixel in tqdm(EVENTS_PER_PIXEL, "overlapping windows", unit="size"):
        for carry in (False, True):
            found = [_sliding_scores(one, per_pixel, times, carry, context) for one in recordings]
            means = {name: float(np.mean([scores[name] for scores in found])) for name in found[0]}
            table.append({"events_per_pixel": per_pixel, "carry": carry, "spacing_us": spacing_us, **means})
    return table


def _sliding_scores(
    recording: Recording, per_pixel: float, times: Sequence[int], carry: bool, context: Context
) -> Mapping[str, float]:
    first = recording.events[0]
    count = max(2, round(per_pixel * first.height * first.width))
    frames = sliding_recovery(recording, count, times, carry, context)
    truth, valid = recording.dolp, recording.valid
    spans = [_length_us(last) for last in _last(recording.events, count, times[len(times) // 2])]
    scores = {
        "mse": mse(frames, truth, valid),
        "psnr": psnr(frames, truth, valid),
        "corr": correlation(frames, truth, valid),
    }
    return {
        **{name: float(values.mean()) for name, values in scores.items()},
        "change": float(frames.diff(dim=0).abs().mean()),
        "true_change": float(truth.diff(dim=0).abs().mean()),
        "window_ms": float(np.mean(spans)) / 1000,
    }
