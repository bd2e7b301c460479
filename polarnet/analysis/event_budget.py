"""How many events DoLP needs (paper, section 5 and Fig. 11).

Quality against the events per pixel since the start of the motion (Fig. 11a; the paper finds about one) and against the
length of the windows. Events per pixel are the mean over the four channels, as in the paper.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from polarnet.benchmark.rows import Context, predictions_of
from polarnet.benchmark.score import FrameScore, mean_scores, score_sequence
from polarnet.benchmark.sequences import TestSequence
from polarnet.events.stream import Events, slice_count, slice_time
from polarnet.events.streaming import BIN_EDGES, EventWindow, events_per_pixel
from polarnet.methods.method import Recoverer
from polarnet.simulation.camera import grid
from polarnet.simulation.dataset import motion_over
from polarnet.simulation.truth import frames_of, valid_frames
from polarnet.storage.events import EventStore
from polarnet.storage.scenes import SceneStore
from polarnet.terminal.progress import ProgressBar

SHOWN = ("mse", "psnr", "ssim", "corr", "skill")


def sequence_at(scenes: SceneStore, name: str, events: Sequence[Events], t_us: Int64[Tensor, " n"]) -> TestSequence:
    """Events of a stored sequence, with exact truth at the window boundaries `t_us`."""
    scene, trajectory, _ = motion_over(scenes, name)
    pixels = grid(scenes.attributes["layout"], scenes.sensor_height, scenes.sensor_width)
    intensity, dolp, aolp = (frames[1:] for frames in frames_of(scene, trajectory, t_us.tolist(), *pixels))
    mask, crosstalk = scenes.read(name).valid if scenes.masked else None, scenes.attributes.get("crosstalk", 0.0)
    valid = None if mask is None else valid_frames(mask, trajectory, t_us.tolist()[1:], pixels, crosstalk)
    s0 = intensity[:, 0] + intensity[:, 2]
    return TestSequence(name, scenes.scene_of[name], events, t_us, dolp, aolp, s0, valid)


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
    scenes: SceneStore,
    events: EventStore,
    names: Sequence[str],
    lengths_us: Sequence[int],
    settle_us: int,
    methods: Sequence[str],
    context: Context,
) -> dict[str, list[dict]]:
    """Mean scores and events per window, by method and window length, over windows that end after `settle_us`.

    The truth is rendered at the end of each window. ValueError if no window of some length ends after `settle_us`.
    """
    table: dict[str, list[dict]] = {method: [] for method in methods}
    for length_us in ProgressBar(lengths_us, "window length", unit="length"):
        rows: list[FrameScore] = []
        per_window: list[float] = []
        for name in names:
            end_us = scenes.duration_us(name)
            t_us = torch.arange(0, end_us + 1, length_us)
            warmup = int((t_us[1:] <= settle_us).sum())
            if warmup >= len(t_us) - 1:
                raise ValueError(
                    f"{name}: windows of {length_us} us leave none after the first {settle_us} us of {end_us} us"
                )
            test = sequence_at(scenes, name, events.read(name), t_us)
            rows += score_sequence(test, predictions_of(methods, test, context), warmup, None, context.device)
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
    stops = [int(torch.searchsorted(events.t, t_us)) for events in channels]
    last = [slice_count(events, max(0, stop - count), stop) for events, stop in zip(channels, stops, strict=True)]
    return EventWindow(last, min((int(events.t[0]) for events in last if len(events)), default=t_us), t_us)


@torch.no_grad()
def recovered_alone(windows: Sequence[EventWindow], recoverer: Recoverer) -> Float[Tensor, "n h w"]:
    """DoLP from each window alone, without a state."""
    first = windows[0].channels[0]
    start = recoverer.start(first.height, first.width)
    return torch.cat([recoverer.step(start, [window])[1].dolp.cpu() for window in windows])
