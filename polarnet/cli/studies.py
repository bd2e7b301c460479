"""Studies of event budget and sensitivity on the pipeline's test sequences; each writes JSON and a figure."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from polarnet.benchmark.conditions import announced, configured, stored
from polarnet.benchmark.event_budget import between_windows, by_sliding_window, by_window_length, since_start
from polarnet.benchmark.rows import ROWS, metadata_used, why_left_out
from polarnet.benchmark.run import train_mean_dolp
from polarnet.benchmark.sensitivity import sensitivity
from polarnet.config.pipeline import context_of, pipeline_set
from polarnet.config.tree import Config
from polarnet.reports.curves import event_budget_figure, sensitivity_figure
from polarnet.reports.figures import LIGHT
from polarnet.reports.maps import png
from polarnet.runtime.machine import threads_of
from polarnet.storage.scenes import SceneStore

WINDOW_LENGTHS_US = (5_000, 10_000, 20_000, 33_333, 50_000, 100_000)
SPACING_US = 500
SLIDING_FRAMES = 60
SET_THEM = "To study sequences like those of the training, write into params.yaml and run `dvc repro`:"
STUDIED = ("oracle_mean", "cf", "highpass", "ours")


def run_event_budget(
    config: Config, out: Path, methods: Sequence[str], limit: int | None, weights: Path | None
) -> dict[str, Any]:
    """Write event_budget.json and event_budget.png to `out`; ValueError if `ours` has no weights."""
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
    return _written(out, "event_budget", results, png(event_budget_figure(results, LIGHT)))


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
    return _written(out, "sensitivity", results, png(sensitivity_figure(table, LIGHT)))


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
