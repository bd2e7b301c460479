"""Run every method on every sequence of a test set, score it, measure its cost and keep panels."""

import functools
import operator
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch

from polarnet.benchmark.rows import Context, cost_of, predictions_of
from polarnet.benchmark.score import BenchmarkConfig, Cost, FrameScore, score_sequence, scored_windows
from polarnet.benchmark.sequences import BenchmarkSet, TestSequence
from polarnet.events.representations import event_tensor, polarity_sums
from polarnet.events.streaming import encode_windows
from polarnet.metrics.lpips import Lpips
from polarnet.metrics.reliability import HIGHEST, LOWEST, Reliability, reliability
from polarnet.stokes import Prediction
from polarnet.storage.frames import dequantise, quantise
from polarnet.storage.panels import Panel, Shown, angle_bytes, fraction_bytes, signed_bytes
from polarnet.terminal.progress import ProgressBar

MAX_FILM_FRAMES = 12
"""Frames of the report's player for each scene; they keep a page of 50 scenes below 30 MB."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class Benchmark:
    """Results of one test set, or of one of its sequences."""

    rows: Sequence[FrameScore]
    costs: Mapping[str, Cost]
    panels: Sequence[Panel]
    reliability: Mapping[str, Reliability] = field(default_factory=dict)
    """Reliability of the expected errors, for the methods that predict them."""


def run_benchmark(
    test_set: BenchmarkSet,
    context: Context,
    config: BenchmarkConfig,
    lpips: Lpips | None,
    mapper: Callable[..., Iterable[Any]] = map,
) -> Benchmark:
    """Run and score `config.methods` on a test set; ValueError if it has no sequence.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each task is one
    sequence. Costs are measured in this process, one method after another, on the first sequence.
    """
    names = test_set.sequences
    firsts: dict[str, str] = {}
    for name in names:
        firsts.setdefault(test_set.frames.original_of(name), name)
    score = functools.partial(
        _scored,
        test_set=test_set,
        context=context,
        config=config,
        lpips=None if lpips is None else lpips.to(context.device),
        with_panel=_spread([*firsts.values()], config.panel_scenes),
    )
    results: list[Benchmark] = list(mapper(score, names))
    first = test_set.sequence(names[0])
    costs = {row: cost_of(row, first, context) for row in ProgressBar(config.methods, "cost", unit="method")}
    sums = {
        row: functools.reduce(operator.add, (result.reliability[row] for result in results))
        for row in results[0].reliability
    }
    rows = [row for result in results for row in result.rows]
    return Benchmark(rows, costs, [panel for result in results for panel in result.panels], sums)


def _scored(
    name: str,
    test_set: BenchmarkSet,
    context: Context,
    config: BenchmarkConfig,
    lpips: Lpips | None,
    with_panel: Collection[str],
) -> Benchmark:
    """Results of every row on a sequence, which is read once; without costs."""
    sequence, warmup = test_set.sequence(name), config.warmup_windows
    predictions = predictions_of(config.methods, sequence, context)
    predictions = {row: at_stored_precision(prediction) for row, prediction in predictions.items()}
    rows = score_sequence(sequence, predictions, warmup, lpips, context.device)
    panels = [panel_of(sequence, predictions, warmup)] if name in with_panel else []
    valid = None if sequence.valid is None else sequence.valid[warmup:]
    sums = {
        row: reliability(one.log_variance[warmup:], one.dolp[warmup:], sequence.dolp[warmup:], valid)
        for row, one in predictions.items()
        if one.log_variance is not None
    }
    return Benchmark(rows, {}, panels, sums)


def at_stored_precision(prediction: Prediction) -> Prediction:
    """The prediction in the steps of the stored truth: DoLP 1/65535, AoLP pi/65536; log-variance as float16."""
    aolp, log_variance = prediction.aolp, prediction.log_variance
    return Prediction(
        dequantise("dolp", quantise("dolp", prediction.dolp)),
        None if aolp is None else dequantise("aolp", quantise("aolp", aolp.remainder(torch.pi))),
        None if log_variance is None else log_variance.clamp(LOWEST, HIGHEST).half().float(),
    )


def _spread(values: Sequence[Item], count: int) -> list[Item]:
    """At most `count` of the values, spread evenly, both ends included."""
    count = min(count, len(values))
    return [values[round(i * (len(values) - 1) / max(count - 1, 1))] for i in range(count)]


def panel_of(sequence: TestSequence, predictions: Mapping[str, Prediction], warmup_windows: int) -> Panel:
    """Panel of the middle scored window, with a film of windows spread evenly over the scored ones."""
    scored, windows = scored_windows(sequence, warmup_windows), sequence.windows()
    k = scored[len(scored) // 2]
    film = _spread(scored, MAX_FILM_FRAMES)
    counts = [torch.stack([polarity_sums(channel) for channel in windows[one].channels]).sum(0) for one in film]

    def shown(maps: Prediction) -> Shown:
        aolp, film_aolp = (None, None) if maps.aolp is None else (maps.aolp[k], angle_bytes(maps.aolp[film]))
        return Shown(maps.dolp[k], aolp, fraction_bytes(maps.dolp[film]), film_aolp)

    return Panel(
        sequence.name,
        k,
        int(sequence.t_us[k + 1]),
        events=encode_windows(sequence.events, sequence.t_us[k : k + 2], event_tensor)[0],
        s0=sequence.s0[k],
        film_t_us=sequence.t_us[[one + 1 for one in film]],
        film_events=signed_bytes(torch.stack(counts)),
        film_s0=fraction_bytes(sequence.s0[film]),
        truth=shown(Prediction(sequence.dolp, sequence.aolp)),
        predictions={row: shown(prediction) for row, prediction in predictions.items()},
    )
