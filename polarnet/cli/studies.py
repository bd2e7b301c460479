"""Studies of event budget and sensitivity on the pipeline's test sequences; each writes JSON and a figure."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.analysis.conditions import announced, configured
from polarnet.analysis.conditions import stored as from_attributes
from polarnet.analysis.event_budget import (
    between_windows,
    by_sliding_window,
    by_window_length,
    growing_window,
    last_window,
    recovered_alone,
    since_start,
)
from polarnet.analysis.resimulate import StoredSequences
from polarnet.analysis.sensitivity import Emulation, sensitivity
from polarnet.benchmark.rows import Context, metadata_used, opened, why_left_out
from polarnet.benchmark.sequences import TestSequence, train_mean_dolp
from polarnet.config.pipeline import context_of, pipeline_set, set_names
from polarnet.config.tree import Config
from polarnet.events.representations import event_tensor
from polarnet.events.streaming import EventWindow
from polarnet.methods import METHODS, ROWS
from polarnet.methods.method import Recoverer
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

    ValueError if `ours` has no weights.
    """
    stored, context = _prepared(config, [*dict.fromkeys([*methods, "ours"])], limit, weights)
    if reason := why_left_out("ours", context):
        raise ValueError(f"the event budget needs the DoLP network: {reason}; give --weights FILE")
    recoverer, tests = opened(METHODS["ours"], context), pipeline_set(config, "simulated")
    used = from_attributes(stored.events.attributes, stored.events.height, stored.events.width)
    conditions = announced(used, metadata_used(methods, context), SET_THEM)
    end_us = min(stored.scenes.duration_us(name) for name in stored.names)
    window_us = round(1e6 / config.synthesize.frame_rate_hz)
    settle_us = round(config.benchmark.warmup_windows * 1e6 / config.synthesize.frame_rate_hz)
    lengths = [length for length in WINDOW_LENGTHS_US if settle_us + length <= end_us]
    first = min(end_us // 2, end_us - SPACING_US)
    times_us = range(first, min(first + SLIDING_FRAMES * SPACING_US, end_us) + 1, SPACING_US)
    results = {
        "methods": list(methods),
        "sequences": list(stored.names),
        "conditions": conditions,
        "since_start": since_start((tests.sequence(name) for name in stored.names), methods, context),
        "window_length": by_window_length(stored, lengths, settle_us, methods, context),
        "sliding": by_sliding_window(stored, times_us, recoverer),
        "between": between_windows(stored, times_us, window_us, recoverer, config.between),
    }
    for test_set in (pipeline_set(config, name) for name in set_names(config) if name in EXPERIMENTS):
        _write_figure_11(out, test_set.name, test_set.sequence(test_set.sequences[0]), recoverer)
    return _written(out, "event_budget", results, png(event_budget_figure(results)))


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


def run_sensitivity(
    config: Config, out: Path, methods: Sequence[str], limit: int | None, weights: Path | None
) -> dict[str, Any]:
    """Write sensitivity.json and sensitivity.png to `out`."""
    stored, context = _prepared(config, methods, limit, weights)
    size = {"sensor_height": stored.scenes.sensor_height, "sensor_width": stored.scenes.sensor_width}
    motion = dataclasses.replace(config.synthesize, **size)  # emulated again at the scenes' sensor size
    conditions = announced(configured(motion, config.emulate), metadata_used(methods, context), SET_THEM)
    emulation = Emulation(config.synthesize, config.camera, config.seed, threads_of(config.runtime))
    table = sensitivity(stored.scenes, stored.names, emulation, methods, context, config.benchmark.warmup_windows)
    results = {"methods": list(methods), "sequences": list(stored.names), "conditions": conditions, "settings": table}
    return _written(out, "sensitivity", results, png(sensitivity_figure(table)))


def _prepared(
    config: Config, methods: Sequence[str], limit: int | None, weights: Path | None
) -> tuple[StoredSequences, Context]:
    """Test sequences and the inputs of the methods; ValueError for a method that does not exist."""
    unknown = [method for method in methods if method not in ROWS]
    if unknown or not methods:
        raise ValueError(f"--methods: expected some of {', '.join(ROWS)}, got {', '.join(unknown) or 'none'}")
    tests = pipeline_set(config, "simulated")
    context = context_of(config, methods, train_mean_dolp(tests.frames, config.benchmark.warmup_windows), weights)
    return StoredSequences(SceneStore.open(config.paths.scenes), tests.events, tests.sequences[:limit]), context


def _written(out: Path, name: str, results: dict[str, Any], picture: bytes) -> dict[str, Any]:
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.json").write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    (out / f"{name}.png").write_bytes(picture)
    return results
