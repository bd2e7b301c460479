"""The benchmark: runs every method on every sequence of a test set, scores it, measures its cost and saves panels."""

import dataclasses
import functools
import json
import platform
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.benchmark.cache import FORMAT, Cache, sequence_digest
from polarnet.benchmark.cost import Cost, cost_of
from polarnet.benchmark.paired import paired_comparisons
from polarnet.benchmark.references import REFERENCES, mean_dolp
from polarnet.benchmark.rows import Context, predictions_of
from polarnet.benchmark.score import (
    METRICS,
    BenchmarkConfig,
    FrameScore,
    scene_means,
    score_sequence,
    scored_windows,
    summary,
    write_frames,
)
from polarnet.benchmark.sequences import TestSequence
from polarnet.events.representations import event_tensor
from polarnet.events.windows import encode_windows
from polarnet.methods import METHODS
from polarnet.metrics.reliability import Reliability, reliability
from polarnet.metrics.similarity import Lpips
from polarnet.runtime.fingerprint import code_digest, digest, method_digest, value_digest
from polarnet.stokes import Prediction
from polarnet.storage.events import EventStore
from polarnet.storage.frames import FrameStore


@dataclass(frozen=True)
class Panel:
    """One window of one scene: its events, the truth, and the prediction of each method."""

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
    """AoLP by method, for the methods that predict it."""


@dataclass(frozen=True)
class Benchmark:
    """Results of one test set."""

    rows: Sequence[FrameScore]
    costs: Mapping[str, Cost]
    panels: Sequence[Panel]
    reliability: Mapping[str, Reliability] = field(default_factory=dict)
    """Reliability of the expected errors, for the methods that predict them."""


@dataclass(frozen=True)
class SequenceResult:
    """Results of one sequence, from one pass over it."""

    rows: Sequence[FrameScore]
    reliability: Mapping[str, Reliability]
    panel: Panel | None


@dataclass(frozen=True)
class BenchmarkSet:
    """Test sequences with their truth."""

    name: str
    events: EventStore
    frames: FrameStore

    @property
    def sequences(self) -> list[str]:
        """Sequences of the test split, in the store's order; ValueError if there are none."""
        names = self.frames.of_split("test")
        if not names:
            raise ValueError(
                f"{self.frames.path} has no test sequence; raise ingest.test_fraction or ingest more pictures"
            )
        return names

    def scene_of(self, sequence: str) -> str:
        """The source picture of a sequence. If the frame store names no scenes, every sequence is its own scene."""
        return self.frames.attributes.get("scenes", {}).get(sequence, sequence)

    def sequence(self, name: str) -> TestSequence:
        """One sequence with its truth."""
        truth = self.frames.frames(name)
        i0, _, i90, _ = truth.intensity[1:].unbind(1)
        events = self.events.read(name)
        scene = self.scene_of(name)
        valid = None if truth.valid is None else truth.valid[1:]
        return TestSequence(name, scene, events, truth.t_us, truth.dolp[1:], truth.aolp[1:], i0 + i90, valid)


def train_mean_dolp(frames: FrameStore, warmup_windows: int) -> float:
    """Mean DoLP of the training split, over the windows and pixels that the benchmark scores."""

    def scored(name: str) -> Tensor:
        dolp, valid = frames.dolp(name)[1 + warmup_windows :], frames.valid(name)
        return dolp if valid is None else dolp[valid[1 + warmup_windows :]]

    return mean_dolp(scored(name) for name in frames.of_split("train"))


def run_benchmark(
    test_set: BenchmarkSet,
    context: Context,
    config: BenchmarkConfig,
    lpips: Lpips | None,
    cache: Path,
    mapper: Callable[..., Iterable[Any]] = map,
) -> Benchmark:
    """Run and score `config.methods` on a test set; ValueError if it has no sequence.

    Results in `cache` are reused while method, sequence and code are unchanged (see `Cache`), so adding a method
    runs only that method. `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`;
    each task is one sequence. Costs are measured in this process, one method after another, on the first sequence.
    """
    names = test_set.sequences
    if lpips is not None:
        lpips = lpips.to(context.device)
    kept = Cache(cache / test_set.name)
    digests = {row: _row_digest(row, context) for row in config.methods}
    scoring = digest(code_digest(score_sequence), str(config.warmup_windows), _lpips_digest(lpips))
    shown = _spread(names, config.panel_scenes, {name: test_set.scene_of(name) for name in names})
    task = functools.partial(
        _measured,
        test_set=test_set,
        context=context,
        digests=digests,
        scoring=scoring,
        config=config,
        lpips=lpips,
        cache=kept,
        shown=shown,
    )
    results: list[SequenceResult] = list(mapper(task, names))
    costs = _costs(test_set.sequence(names[0]), context, digests, kept)
    kept.forget([*names])
    sums: dict[str, Reliability] = {}
    for result in results:
        for method, here in result.reliability.items():
            sums[method] = sums[method] + here if method in sums else here
    rows = [row for result in results for row in result.rows]
    panels = [result.panel for result in results if result.panel is not None]
    return Benchmark(rows, costs, panels, sums)


def _measured(
    name: str,
    test_set: BenchmarkSet,
    context: Context,
    digests: Mapping[str, str],
    scoring: str,
    config: BenchmarkConfig,
    lpips: Lpips | None,
    cache: Cache,
    shown: Collection[str],
) -> SequenceResult:
    """Run and score every row on one sequence, which is read once; cached predictions and scores are reused."""
    sequence = test_set.sequence(name)
    keys = _prediction_keys(sequence, digests)
    predictions = {row: known for row, key in keys.items() if (known := cache.prediction(row, name, key)) is not None}
    made = predictions_of([row for row in keys if row not in predictions], sequence, context)
    predictions |= {row: cache.write_prediction(row, name, keys[row], made[row]) for row in made}
    ordered = {row: predictions[row] for row in keys}
    score_keys = {row: digest(key, scoring) for row, key in keys.items()}
    scores = {row: rows for row, key in score_keys.items() if (rows := cache.scores(row, name, key)) is not None}
    unscored = {row: prediction for row, prediction in ordered.items() if row not in scores}
    if unscored:  # together, so that LPIPS's features of the truth are computed once
        scored = score_sequence(sequence, unscored, config.warmup_windows, lpips, context.device)
        for row in unscored:
            scores[row] = [score for score in scored if score.method == row]
            cache.write_scores(row, name, score_keys[row], scores[row])
    rows = [score for row in keys for score in scores[row]]
    panel = _panel(sequence, ordered, config.warmup_windows) if name in shown else None
    return SequenceResult(rows, _reliability(sequence, ordered, config.warmup_windows), panel)


def _row_digest(row: str, context: Context) -> str:
    """A hash of a row's code, settings and weights."""
    if row in REFERENCES:
        reference = REFERENCES[row]
        return digest(code_digest(reference.predict), str(context.train_mean if reference.needs_train_mean else None))
    method = METHODS[row]
    return method_digest(method.open, context.setup_of(method))


def _prediction_keys(sequence: TestSequence, digests: Mapping[str, str]) -> dict[str, str]:
    of_sequence = sequence_digest(sequence)
    return {method: digest(FORMAT, of_method, of_sequence) for method, of_method in digests.items()}


def _lpips_digest(lpips: Lpips | None) -> str:
    if lpips is None:
        return "none"
    return digest(lpips.backbone, *(f"{name}={value_digest(t)}" for name, t in lpips.state_dict().items()))


def _costs(sequence: TestSequence, context: Context, digests: Mapping[str, str], cache: Cache) -> dict[str, Cost]:
    """Cost of each method; cached costs are reused on the same machine with the same number of threads."""
    device = torch.cuda.get_device_name(context.device) if context.device.type == "cuda" else "cpu"
    here = digest(platform.node(), platform.machine(), device, str(torch.get_num_threads()))
    costs = {}
    for method, key in _prediction_keys(sequence, digests).items():
        cost_key = digest(key, here)
        if (cost := cache.cost(method, cost_key)) is None:
            cost = cost_of(method, sequence, context)
            cache.write_cost(method, cost_key, cost)
        costs[method] = cost
    return costs


def write_benchmark(
    folder: Path, benchmark: Benchmark, config: BenchmarkConfig, seed: int, about: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Write metrics.json, details.json (`about`, settings), frames.csv, panels/<sequence>.npz; return the metrics."""
    shutil.rmtree(folder / "panels", ignore_errors=True)  # an earlier run may have saved other scenes
    (folder / "panels").mkdir(parents=True)
    backbone = {"lpips_backbone": config.lpips_backbone} if config.lpips else {}
    metrics: dict[str, dict[str, Any]] = {
        method: {**scores, **backbone, **dataclasses.asdict(benchmark.costs[method])}
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
        "scene_means": {metric: of_methods for metric, of_methods in means.items() if of_methods},
        "paired": paired_comparisons(benchmark.rows, "ours"),
        "reliability": {
            method: {"curve": sums.curve(), "log_error": sums.log_error()}
            for method, sums in benchmark.reliability.items()
        },
    }
    for name, content in (("metrics", metrics), ("details", details)):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    write_frames(folder / "frames.csv", benchmark.rows)
    for panel in benchmark.panels:
        _write_panel(folder / "panels" / f"{panel.sequence}.npz", panel)
    return metrics


def _spread(names: Sequence[str], count: int, scenes: Mapping[str, str]) -> set[str]:
    """First sequence of each of `count` scenes, spread evenly over the split, both ends included."""
    first = list({scenes.get(name, name): name for name in reversed(names)}.values())[::-1]
    count = min(count, len(first))
    return {first[round(i * (len(first) - 1) / max(count - 1, 1))] for i in range(count)}


def _reliability(
    sequence: TestSequence, predictions: Mapping[str, Prediction], warmup_windows: int
) -> dict[str, Reliability]:
    """Reliability over the scored windows, for each method that predicts its error."""
    windows = slice(scored_windows(sequence, warmup_windows).start, None)
    valid = None if sequence.valid is None else sequence.valid[windows]
    truth = sequence.dolp[windows]
    return {
        method: reliability(prediction.log_variance[windows], prediction.dolp[windows], truth, valid)
        for method, prediction in predictions.items()
        if prediction.log_variance is not None
    }


def _panel(sequence: TestSequence, predictions: Mapping[str, Prediction], warmup_windows: int) -> Panel:
    """Panel of the middle scored window."""
    windows = scored_windows(sequence, warmup_windows)
    k = windows[len(windows) // 2]
    return Panel(
        sequence.name,
        sequence.scene,
        k,
        int(sequence.t_us[k + 1]),
        encode_windows(sequence.events, sequence.t_us[k : k + 2], event_tensor)[0],
        sequence.dolp[k],
        sequence.aolp[k],
        sequence.s0[k],
        {method: prediction.dolp[k] for method, prediction in predictions.items()},
        {method: prediction.aolp[k] for method, prediction in predictions.items() if prediction.aolp is not None},
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
