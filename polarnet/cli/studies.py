"""The event budget of the pipeline's test sequences (paper, Fig. 11), as JSON and figures."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.analysis.conditions import conditions, sentence, warnings
from polarnet.analysis.event_budget import (
    by_window_length,
    growing_window,
    last_window,
    recovered_alone,
    since_start,
)
from polarnet.benchmark.rows import metadata_used, opened, why_left_out
from polarnet.benchmark.sequences import TestSequence, train_mean_dolp
from polarnet.config.pipeline import context_of, pipeline_set, set_names
from polarnet.config.tree import Config
from polarnet.events.representations import event_tensor
from polarnet.events.streaming import EventWindow
from polarnet.methods import METHODS, ROWS
from polarnet.methods.method import Recoverer
from polarnet.reports.charts import PAPER_EVENTS_PER_PIXEL, event_budget_figure
from polarnet.reports.maps import png, write_figure
from polarnet.reports.paper import EXPERIMENTS, Moment, figure_11
from polarnet.storage.scenes import SceneStore

WINDOW_LENGTHS_US = (5_000, 10_000, 20_000, 33_333, 50_000, 100_000)
GROWING_EVENTS_PER_PIXEL = (0.1, 0.25, 0.5, PAPER_EVENTS_PER_PIXEL, 2.0, 4.0)
"""Events per pixel in the growing windows of Fig. 11a."""
STUDIED = ("oracle_mean", "cf", "highpass", "ours")


def run_event_budget(
    config: Config, out: Path, methods: Sequence[str], limit: int | None, weights: Path | None
) -> dict[str, Any]:
    """Write event_budget.json and .png and the paper's Fig. 11 of a sequence a set; ValueError without weights."""
    unknown = [method for method in methods if method not in ROWS]
    if unknown or not methods:
        raise ValueError(f"--methods: expected some of {', '.join(ROWS)}, got {', '.join(unknown) or 'none'}")
    tests, scenes = pipeline_set(config, "simulated"), SceneStore.open(config.paths.scenes)
    events, names, warmup_windows = tests.events, tests.sequences[:limit], config.benchmark.warmup_windows
    needed = [*dict.fromkeys([*methods, "ours"])]
    context = context_of(config, needed, train_mean_dolp(tests.frames, warmup_windows), weights)
    if reason := why_left_out("ours", context):
        raise ValueError(f"the event budget needs the DoLP network: {reason}; give --weights FILE")
    used = conditions(config.synthesize, config.emulate)
    differences = warnings(used, metadata_used(methods, context))
    print("\n".join([sentence(used), *(f"WARNING: {line}" for line in differences)]), flush=True)
    end_us = min(scenes.duration_us(name) for name in names)
    settle_us = round(warmup_windows * 1e6 / config.synthesize.frame_rate_hz)
    lengths = [length for length in WINDOW_LENGTHS_US if settle_us + length <= end_us]
    results = {
        "methods": list(methods),
        "sequences": list(names),
        "conditions": {"sentence": sentence(used), **used},
        "since_start": since_start((tests.sequence(name) for name in names), methods, context),
        "window_length": by_window_length(scenes, events, names, lengths, settle_us, methods, context),
    }
    recoverer = opened(METHODS["ours"], context)
    out.mkdir(parents=True, exist_ok=True)
    (out / "event_budget.json").write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    (out / "event_budget.png").write_bytes(png(event_budget_figure(results)))
    for name in set_names(config):
        if name in EXPERIMENTS:
            test_set = pipeline_set(config, name)
            _write_figure_11(out, name, test_set.sequence(test_set.sequences[0]), recoverer)
    return results


def _write_figure_11(out: Path, name: str, sequence: TestSequence, recoverer: Recoverer) -> None:
    """Write the paper's Fig. 11 of one sequence: a window that grows from 0, and the last events before each time."""
    events, end_us = sequence.events, int(sequence.t_us[-1])
    pixels = events[0].height * events[0].width
    t_us = torch.cat([channel.t for channel in events]).sort().values
    counts = [int(len(events) * pixels * share) for share in GROWING_EVENTS_PER_PIXEL]
    growing = [growing_window(events, int(t_us[n - 1]) + 1) for n in counts if 0 < n <= len(t_us)]
    enough = min(int(len(events) * pixels * PAPER_EVENTS_PER_PIXEL), len(t_us))
    if not growing:
        return
    times = torch.linspace(int(t_us[enough - 1]) + 1, end_us, len(GROWING_EVENTS_PER_PIXEL)).long().tolist()
    sliding = [last_window(events, round(PAPER_EVENTS_PER_PIXEL * pixels), time) for time in times]
    for part, windows in (("a", growing), ("b", sliding)):
        recovered = recovered_alone(windows, recoverer)
        moments = [_moment(sequence, *pair) for pair in zip(windows, recovered, strict=True)]
        write_figure(figure_11(moments), out / f"figure_11{part}_{name}")


def _moment(sequence: TestSequence, window: EventWindow, recovered: Float[Tensor, "h w"]) -> Moment:
    """A column of Fig. 11, with the true frame closest to the end of the window."""
    last_us = max(int(events.t[-1]) for events in window.channels if len(events))
    count = round(sum(map(len, window.channels)) / len(window.channels))
    truth = sequence.dolp[int((sequence.t_us[1:] - window.stop_us).abs().argmin())]
    return Moment(last_us, count, event_tensor(window.channels[0], window.length_us), recovered, truth)
