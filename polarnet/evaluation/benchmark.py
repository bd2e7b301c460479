"""The benchmark: every method on every sequence of a test set, scored, its cost measured, a few windows to look at."""

import dataclasses
import functools
import json
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from polarnet.baselines.trivial import mean_dolp
from polarnet.evaluation.cache import FORMAT, Cache, sequence_digest
from polarnet.evaluation.cost import Cost, cost_of
from polarnet.evaluation.methods import METHODS, Context, Polarization, Recording, recover
from polarnet.evaluation.paired import paired_comparisons
from polarnet.evaluation.reliability import Reliability, reliability
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
from polarnet.fingerprint import code_digest, digest, method_digest, value_digest
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
    """All that was measured on one test set."""

    rows: Sequence[FrameScore]
    costs: Mapping[str, Cost]
    panels: Sequence[Panel]
    reliability: Mapping[str, Reliability] = field(default_factory=dict)
    """Of the methods that say how large their error is to be expected."""


@dataclass(frozen=True)
class BenchmarkSet:
    """Sequences with truth that methods are tested on."""

    name: str
    events: EventStore
    frames: FrameStore

    @property
    def sequences(self) -> list[str]:
        """Those of the test split, in the store's order; ValueError where there is none."""
        names = self.frames.of_split("test")
        if not names:
            raise ValueError(
                f"{self.frames.path} has no test sequence; raise ingest.test_fraction or ingest more pictures"
            )
        return names

    def scene_of(self, sequence: str) -> str:
        """The source picture of a sequence. A frame store that names no scenes has one for each sequence."""
        return self.frames.attributes.get("scenes", {}).get(sequence, sequence)

    def recording(self, sequence: str) -> Recording:
        """One sequence with its truth."""
        truth = self.frames.frames(sequence)
        i0, _, i90, _ = truth.intensity[1:].unbind(1)
        events = self.events.read(sequence)
        scene = self.scene_of(sequence)
        valid = None if truth.valid is None else truth.valid[1:]
        return Recording(sequence, scene, events, truth.t_us, truth.dolp[1:], truth.aolp[1:], i0 + i90, valid)

    def recordings(self) -> Iterator[Recording]:
        """All of them, one after another."""
        return map(self.recording, self.sequences)


def train_mean_dolp(frames: FrameStore, warmup_windows: int) -> float:
    """Mean DoLP of the training split over the windows and pixels that a benchmark would score."""

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
    """Run and score `config.methods` on a test set; ValueError where it has no sequence.

    What `cache` holds of the same method, sequence and code is not made again (see `Cache`), so that a new method costs
    its own time alone. `mapper` is `polarnet.cluster.pmap` with its workers bound, or the built-in `map`; each of its
    tasks is one sequence. Costs are measured here, one method after another, on the first sequence.
    """
    names = test_set.sequences
    if lpips is not None:
        lpips = lpips.to(context.device)
    kept = Cache(cache / test_set.name)
    digests = {method: method_digest(METHODS[method], context) for method in config.methods}
    scoring = digest(code_digest(score_sequence), str(config.warmup_windows), _lpips_digest(lpips))
    task = functools.partial(
        _recover_and_score,
        test_set=test_set,
        context=context,
        digests=digests,
        scoring=scoring,
        config=config,
        lpips=lpips,
        cache=kept,
    )
    rows = [row for of_sequence in mapper(task, names) for row in of_sequence]
    costs = _costs(test_set.recording(names[0]), context, digests, kept)
    shown = _spread(names, config.panel_scenes, {name: test_set.scene_of(name) for name in names})
    panels = [_panel(test_set.recording(name), digests, kept, config.warmup_windows) for name in names if name in shown]
    kept.forget([*names])
    return Benchmark(rows, costs, panels, _reliability(test_set, digests, kept, config.warmup_windows))


def _recover_and_score(
    sequence: str,
    test_set: BenchmarkSet,
    context: Context,
    digests: Mapping[str, str],
    scoring: str,
    config: BenchmarkConfig,
    lpips: Lpips | None,
    cache: Cache,
) -> list[FrameScore]:
    """The rows of every method on one sequence, made where the cache has none."""
    recording = test_set.recording(sequence)
    keys = _prediction_keys(recording, digests)
    score_keys = {method: digest(key, scoring) for method, key in keys.items()}
    known = {method: cache.scores(method, sequence, key) for method, key in score_keys.items()}
    unscored: dict[str, Polarization] = {}
    for method in [method for method, scores in known.items() if scores is None]:
        if (found := cache.prediction(method, sequence, keys[method])) is None:
            recovered = recover(method, recording, context)
            found = cache.write_prediction(method, sequence, keys[method], recovered.polarization)
        unscored[method] = found
    if unscored:  # together, so that LPIPS's features of the truth are computed once
        scored = score_sequence(recording, unscored, config.warmup_windows, lpips, context.device)
        for method in unscored:
            rows = [row for row in scored if row.method == method]
            cache.write_scores(method, sequence, score_keys[method], rows)
            known[method] = rows
    return [row for scores in known.values() if scores is not None for row in scores]


def _prediction_keys(recording: Recording, digests: Mapping[str, str]) -> dict[str, str]:
    of_sequence = sequence_digest(recording)
    return {method: digest(FORMAT, of_method, of_sequence) for method, of_method in digests.items()}


def _lpips_digest(lpips: Lpips | None) -> str:
    if lpips is None:
        return "none"
    return digest(lpips.backbone, *(f"{name}={value_digest(t)}" for name, t in lpips.state_dict().items()))


def _costs(recording: Recording, context: Context, digests: Mapping[str, str], cache: Cache) -> dict[str, Cost]:
    """Each method's, from the cache where this machine has measured it with as many threads."""
    device = torch.cuda.get_device_name(context.device) if context.device.type == "cuda" else "cpu"
    here = digest(platform.node(), platform.machine(), device, str(torch.get_num_threads()))
    costs = {}
    for method, key in _prediction_keys(recording, digests).items():
        cost_key = digest(key, here)
        if (cost := cache.cost(method, cost_key)) is None:
            cost = cost_of(method, recording, context)
            cache.write_cost(method, cost_key, cost)
        costs[method] = cost
    return costs


def write_benchmark(
    folder: Path, benchmark: Benchmark, config: BenchmarkConfig, seed: int, about: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Write metrics.json, details.json (`about` and the settings), frames.csv, panels/<sequence>.npz; the metrics."""
    shutil.rmtree(folder / "panels", ignore_errors=True)  # a run before may have shown other scenes
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
    """The first sequences of `count` scenes, evenly spread over the split, from its first to its last."""
    first = list({scenes.get(name, name): name for name in reversed(names)}.values())[::-1]
    count = min(count, len(first))
    return {first[round(i * (len(first) - 1) / max(count - 1, 1))] for i in range(count)}


def _reliability(
    test_set: BenchmarkSet, digests: Mapping[str, str], cache: Cache, warmup_windows: int
) -> dict[str, Reliability]:
    """Over the scored windows of all sequences, of each method that expects an error."""
    sums: dict[str, Reliability] = {}
    speaking = dict(digests)  # all that may say something of it, until the first sequence tells
    for recording in test_set.recordings():
        windows = slice(scored_windows(recording, warmup_windows).start, None)
        valid = None if recording.valid is None else recording.valid[windows]
        for method, key in _prediction_keys(recording, speaking).items():
            found = cache.prediction(method, recording.name, key)
            if found is None or found.log_variance is None:
                del speaking[method]
                continue
            here = reliability(found.log_variance[windows], found.dolp[windows], recording.dolp[windows], valid)
            sums[method] = sums[method] + here if method in sums else here
    return sums


def _panel(recording: Recording, digests: Mapping[str, str], cache: Cache, warmup_windows: int) -> Panel:
    """The middle one of the scored windows."""
    windows = scored_windows(recording, warmup_windows)
    k = windows[len(windows) // 2]
    found: dict[str, Polarization] = {}
    for method, key in _prediction_keys(recording, digests).items():
        if (prediction := cache.prediction(method, recording.name, key)) is None:
            raise RuntimeError(f"{cache.folder}: {method} on {recording.name} is gone; something else clears the cache")
        found[method] = prediction
    return Panel(
        recording.name,
        recording.scene,
        k,
        int(recording.t_us[k + 1]),
        encode_windows(recording.events, recording.t_us[k : k + 2], event_tensor)[0],
        recording.dolp[k],
        recording.aolp[k],
        recording.s0[k],
        {method: polarization.dolp[k] for method, polarization in found.items()},
        {method: polarization.aolp[k] for method, polarization in found.items() if polarization.aolp is not None},
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
