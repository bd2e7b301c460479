"""The benchmark: every method on every test sequence, scored, timed, and a few windows kept to be looked at."""

import json
import shutil
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from polarnet.baselines.trivial import mean_dolp
from polarnet.evaluation.methods import Context, Recording, Recovered, recover
from polarnet.evaluation.score import (
    METRICS,
    BenchmarkConfig,
    FrameScore,
    scene_means,
    score_sequence,
    scored_windows,
    summary,
    write_frames,
)
from polarnet.events.frames import FrameStore
from polarnet.events.representations import event_tensor
from polarnet.events.store import EventStore
from polarnet.events.windows import encode_windows
from polarnet.similarity import Lpips


@dataclass(frozen=True)
class Panel:
    """One window of one scene: what went in, the truth, and what each method made of it."""

    sequence: str
    scene: str
    window: int
    t_us: int
    events: Float[Tensor, "4 h w"]
    """The window's event tensors (Eq. 5)."""
    truth_dolp: Float[Tensor, "h w"]
    truth_aolp: Float[Tensor, "h w"]
    truth_s0: Float[Tensor, "h w"]
    dolp: Mapping[str, Float[Tensor, "h w"]]
    aolp: Mapping[str, Float[Tensor, "h w"]]
    """Of the methods that have it."""


@dataclass(frozen=True)
class Benchmark:
    """All that was measured."""

    rows: Sequence[FrameScore]
    ms_per_window: Mapping[str, float]
    """Median over sequences, after one call that is not counted; with the making of the input."""
    panels: Sequence[Panel]


def recordings_of(split: str, events: EventStore, frames: FrameStore) -> Iterator[Recording]:
    """Its sequences, in the store's order. A frame store that names no scenes has one for each sequence."""
    scenes = frames.attributes.get("scenes", {})
    for name in frames.of_split(split):
        truth = frames.frames(name)
        i0, _, i90, _ = truth.intensity[1:].unbind(1)
        valid = None if truth.valid is None else truth.valid[1:]
        scene = scenes.get(name, name)
        yield Recording(name, scene, events.read(name), truth.t_us, truth.dolp[1:], truth.aolp[1:], i0 + i90, valid)


def train_mean_dolp(frames: FrameStore, warmup_windows: int) -> float:
    """Mean DoLP of the training split over the windows and pixels that a benchmark would score."""

    def scored(name: str) -> Tensor:
        dolp, valid = frames.dolp(name)[1 + warmup_windows :], frames.valid(name)
        return dolp if valid is None else dolp[valid[1 + warmup_windows :]]

    return mean_dolp(scored(name) for name in frames.of_split("train"))


def run_benchmark(
    events: EventStore, frames: FrameStore, context: Context, config: BenchmarkConfig, lpips: Lpips | None
) -> Benchmark:
    """Run and score `config.methods` on the test split; ValueError where it has no sequence."""
    names = frames.of_split("test")
    if not names:
        raise ValueError(f"{frames.path} has no test sequence; raise ingest.test_fraction or ingest more pictures")
    if lpips is not None:
        lpips = lpips.to(context.device)
    shown = _spread(names, config.panel_scenes, frames.attributes.get("scenes", {}))
    rows: list[FrameScore] = []
    panels: list[Panel] = []
    ms_per_window: dict[str, list[float]] = {method: [] for method in config.methods}
    for i, recording in enumerate(
        tqdm(recordings_of("test", events, frames), "benchmark", len(names), unit="sequence")
    ):
        if i == 0:
            for method in config.methods:
                recover(method, recording, context)  # loads, compiles and allocates
        recovered = {method: recover(method, recording, context) for method in config.methods}
        for method, found in recovered.items():
            ms_per_window[method].append(1000 * found.seconds / len(recording.dolp))
        dolp = {method: found.dolp for method, found in recovered.items()}
        rows += score_sequence(recording, dolp, config.warmup_windows, lpips, context.device)
        if recording.name in shown:
            panels.append(_panel(recording, recovered, config.warmup_windows))
    return Benchmark(rows, {method: statistics.median(ms) for method, ms in ms_per_window.items()}, panels)


def write_benchmark(
    folder: Path, benchmark: Benchmark, config: BenchmarkConfig, seed: int, about: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Write metrics.json, details.json (`about` and the settings), frames.csv, panels/<sequence>.npz; the metrics."""
    shutil.rmtree(folder / "panels", ignore_errors=True)  # a run before may have shown other scenes
    (folder / "panels").mkdir(parents=True)
    metrics: dict[str, dict[str, Any]] = {
        method: {**scores, "ms_per_window": benchmark.ms_per_window[method]}
        for method, scores in summary(benchmark.rows, config.bootstrap_samples, seed).items()
    }
    means = {metric: scene_means(benchmark.rows, metric) for metric in METRICS}
    details = {
        **about,
        "scenes": sorted({row.scene for row in benchmark.rows}),
        "sequences": sorted({row.sequence for row in benchmark.rows}),
        "frames": len(benchmark.rows) // len(config.methods),
        "warmup_windows": config.warmup_windows,
        "precision": config.precision,
        "bootstrap_samples": config.bootstrap_samples,
        "scene_means": {metric: of_methods for metric, of_methods in means.items() if of_methods is not None},
    }
    for name, content in (("metrics", metrics), ("details", details)):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    write_frames(folder / "frames.csv", benchmark.rows)
    for panel in benchmark.panels:
        _write_panel(folder / "panels" / f"{panel.sequence}.npz", panel)
    return metrics


def _spread(names: Sequence[str], count: int, scenes: Mapping[str, str]) -> set[str]:
    """The first sequences of `count` scenes, evenly spread over the split, from its first to its last."""
    first = list({scenes.get(name, name): name for name in reversed(names)}.values())[::-1]
    count = min(count, len(first))
    return {first[round(i * (len(first) - 1) / max(count - 1, 1))] for i in range(count)}


def _panel(recording: Recording, recovered: Mapping[str, Recovered], warmup_windows: int) -> Panel:
    """The middle one of the scored windows."""
    windows = scored_windows(recording, warmup_windows)
    k = windows[len(windows) // 2]
    return Panel(
        recording.name,
        recording.scene,
        k,
        int(recording.t_us[k + 1]),
        encode_windows(recording.events, recording.t_us[k : k + 2], event_tensor)[0],
        recording.dolp[k],
        recording.aolp[k],
        recording.s0[k],
        {method: found.dolp[k] for method, found in recovered.items()},
        {method: found.aolp[k] for method, found in recovered.items() if found.aolp is not None},
    )


def _write_panel(path: Path, panel: Panel) -> None:
    frames = {
        "events": panel.events,
        "truth_dolp": panel.truth_dolp,
        "truth_aolp": panel.truth_aolp,
        "truth_s0": panel.truth_s0,
        **{f"dolp_{method}": frame for method, frame in panel.dolp.items()},
        **{f"aolp_{method}": frame for method, frame in panel.aolp.items()},
    }
    arrays: dict[str, Any] = {name: frame.numpy() for name, frame in frames.items()}
    np.savez(path, window=np.int64(panel.window), t_us=np.int64(panel.t_us), **arrays)
