"""Studies of event budget and sensitivity on the pipeline's test sequences; each writes JSON and a figure."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.analysis.conditions import announced, configured, stored
from polarnet.analysis.event_budget import (
    between_windows,
    by_sliding_window,
    by_window_length,
    growing_window,
    last_window,
    recovered_alone,
    since_start,
)
from polarnet.analysis.sensitivity import sensitivity
from polarnet.benchmark.rows import ROWS, Context, metadata_used, why_left_out
from polarnet.benchmark.run import train_mean_dolp
from polarnet.benchmark.sequences import TestSequence
from polarnet.config.pipeline import context_of, pipeline_set, set_names
from polarnet.config.tree import Config
from polarnet.events.representations import event_tensor
from polarnet.events.streaming import EventWindow
from polarnet.reports.curves import PAPER_EVENTS_PER_PIXEL, event_budget_figure, sensitivity_figure
from polarnet.reports.maps import png, write_figure
from polarnet.reports.paper import EXPERIMENTS, Moment, figure_11
from polarnet.runtime.machine import threads_of
from polarnet.storage.scenes import SceneStore

WINDOW_LENGTHS_US = (5_000, 10_000, 20_000, 33_333, 50_000, 100_000)
SPACING_US = 500
SLIDING_FRAMES = 60
GROWING_EVENTS_PER_PIXEL = (0.1, 0.25, 0.5, PAPER_EVENTS_PER_PIXEL, 2.0, 4.0)
"""Events per pixel in the growing windows of Fig. 11a."""
SET_THEM = "To study sequences like those of the training, write into params.yaml and run `dvc repro`:"
STUDIED = ("oracle_mean", "cf", "highpass", "ours")


def run_event_budget(
    config: Config, out: Path, methods: Sequence[str], limit: int | None, weights: Path | None
) -> dict[str, Any]:
    """Write event_budget.json, event_budget.png and the paper's Fig. 11 (.png, .pdf) of one sequence a set to `out`.

    Fig. 11 is drawn of the simulated set and, if they are enabled, of the real targets. ValueError if `ours` has no
    weights.
    """
    sequences, context, tests, scenes = _prepared(config, methods, limit, weights)
    if reason := why_left_out("ours", context):
        raise ValueError(f"the event budget needs the DoLP network: {reason}; give --weights FILE")
    events = tests.events
    used = stored(events.attributes, events.height, events.width)
    conditions = announced(used, metadata_used(methods, context), SET_THEM)
    end_us = min(scenes.duration_us(name) for name in sequences)
    settle_us = round(config.benchmark.warmup_windows * 1e6 / config.synthesize.frame_rate_hz)
    lengths = [length for length in WINDOW_LENGTHS_US if settle_us + length <= end_us]
    first = min(end_us // 2, end_us - SPACING_US)
    span = (first, min(first + SLIDING_FRAMES * SPACING_US, end_us))
    window_us = round(1e6 / config.synthesize.frame_rate_hz)
    results = {
        "methods": list(methods),
        "sequences": list(sequences),
        "conditions": conditions,
        "since_start": since_start((tests.sequence(name) for name in sequences), methods, context),
        "window_length": by_window_length(scenes, tests.events, sequences, lengths, settle_us, methods, context),
        "sliding": by_sliding_window(scenes, tests.events, sequences, span, SPACING_US, "ours", context),
        "between": between_windows(
            scenes, tests.events, sequences, span, SPACING_US, window_us, "ours", config.between, context
        ),
    }
    for name in set_names(config):
        if name in EXPERIMENTS:
            test_set = pipeline_set(config, name)
            _write_figure_11(out, name, test_set.sequence(test_set.sequences[0]), context)
    return _written(out, "event_budget", results, png(event_budget_figure(results)))


def _write_figure_11(out: Path, name: str, sequence: TestSequence, context: Context) -> None:
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
        recovered = recovered_alone(windows, "ours", context)
        moments = [_moment(sequence, *pair) for pair in zip(windows, recovered, strict=True)]
        write_figure(figure_11(moments), out / f"figure_11{part}_{name}")


def _moment(sequence: TestSequence, window: EventWindow, recovered: Float[Tensor, "h w"]) -> Moment:
    """A column of Fig. 11, with the true frame closest to the end of the window."""
    last_us = max(int(events.t[-1]) for events in window.channels if len(events))
    count = round(sum(map(len, window.channels)) / len(window.channels))
    truth = sequence.dolp[int((sequence.t_us[1:] - window.stop_us).abs().argmin())]
    return Moment(last_us, count, event_tensor(window.channels[0], window.length_us), recovered, truth)


def run_sensitivity(
    config: Config, out: Path, methods: Sequence[str], limit: int | None, weights: Path | None
) -> dict[str, Any]:
    """Write sensitivity.json and sensitivity.png to `out`."""
    sequences, context, _, scenes = _prepared(config, methods, limit, weights)
    size = {"sensor_height": scenes.sensor_height, "sensor_width": scenes.sensor_width}
    motion = dataclasses.replace(config.synthesize, **size)  # emulated again at the scenes' sensor size
    conditions = announced(configured(motion, config.emulate), metadata_used(methods, context), SET_THEM)
    table = sensitivity(
        scenes, sequences, config.synthesize, config.camera, config.seed, config.benchmark.warmup_windows, methods,
        context, threads=threads_of(config.runtime),
    )  # fmt: skip
    results = {"methods": list(methods), "sequences": list(sequences), "conditions": conditions, "settings": table}
    return _written(out, "sensitivity", results, png(sensitivity_figure(table)))


def _prepared(config: Config, methods: Sequence[str], limit: int | None, weights: Path | None) -> Any:
    unknown = [method for method in methods if method not in ROWS]
    if unknown or not methods:
        raise ValueError(f"--methods: expected some of {', '.join(ROWS)}, got {', '.join(unknown) or 'none'}")
    tests = pipeline_set(config, "simulated")
    scenes = SceneStore.open(config.paths.scenes)
    context = context_of(config, train_mean_dolp(tests.frames, config.benchmark.warmup_windows), weights)
    return tests.sequences[:limit], context, tests, scenes


def _written(out: Path, name: str, results: dict[str, Any], picture: bytes) -> dict[str, Any]:
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    (out / f"{name}.png").write_bytes(picture)
    return results
