"""Run every method on every sequence of a test set, score it, measure its cost and keep panels."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from polarnet.benchmark.rows import Context, predictions_of
from polarnet.benchmark.score import BenchmarkConfig, Cost, FrameScore, score_sequence, scored_windows
from polarnet.benchmark.sequences import BenchmarkSet, TestSequence
from polarnet.events.representations import event_tensor, polarity_sums
from polarnet.events.streaming import encode_windows
from polarnet.metrics.reliability import HIGHEST, LOWEST, Reliability, reliability
from polarnet.metrics.similarity import Lpips
from polarnet.stokes import Prediction
from polarnet.storage.frames import dequantise, quantise
from polarnet.storage.panels import Panel, Shown, angle_bytes, fraction_bytes, signed_bytes

MAX_FILM_FRAMES = 12
"""Frames of the report's player for each scene; they keep a page of 50 scenes below 30 MB."""


@dataclass(frozen=True)
class Benchmark:
    """Results of one test set, or of one of its sequences."""

    rows: Sequence[FrameScore]
    costs: Mapping[str, Cost]
    panels: Sequence[Panel]
    reliability: Mapping[str, Reliability] = field(default_factory=dict)
    """Reliability of the expected errors, for the methods that predict them."""


@dataclass(frozen=True)
class _Measurement:
    """Runs and scores the rows on one sequence after another; each call is a task of its own."""

    test_set: BenchmarkSet
    context: Context
    config: BenchmarkConfig
    lpips: Lpips | None
    with_panel: Collection[str]
    """Sequences that get a panel."""

    def __call__(self, name: str) -> Benchmark:
        """Results of every row on a sequence, which is read once; without costs."""
        sequence = self.test_set.sequence(name)
        predictions = {
            row: at_stored_precision(row, name, prediction)
            for row, prediction in predictions_of(self.config.methods, sequence, self.context).items()
        }
        warmup = self.config.warmup_windows
        rows = score_sequence(sequence, predictions, warmup, self.lpips, self.context.device)
        panels = [panel_of(sequence, predictions, warmup)] if name in self.with_panel else []
        return Benchmark(rows, {}, panels, _reliability(sequence, predictions, warmup))


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
    from polarnet.benchmark.cost import cost_of  # torch's counter of operations takes a second to import

    names = test_set.sequences
    scenes = {name: test_set.frames.original_of(name) for name in names}
    lpips = None if lpips is None else lpips.to(context.device)
    measure = _Measurement(test_set, context, config, lpips, _spread(scenes, config.panel_scenes))
    results: list[Benchmark] = list(mapper(measure, names))
    first = test_set.sequence(names[0])
    costs = {row: cost_of(row, first, context) for row in config.methods}
    sums: dict[str, Reliability] = {}
    for result in results:
        for method, here in result.reliability.items():
            sums[method] = sums[method] + here if method in sums else here
    rows = [row for result in results for row in result.rows]
    return Benchmark(rows, costs, [panel for result in results for panel in result.panels], sums)


def at_stored_precision(row: str, sequence: str, prediction: Prediction) -> Prediction:
    """The prediction in the steps of the stored truth: DoLP 1/65535, AoLP pi/65536; log-variance as float16.

    ValueError, naming the row and the window, if a value is not finite.
    """
    for frames in (prediction.dolp, prediction.aolp, prediction.log_variance):
        if frames is not None and not (finite := frames.isfinite().flatten(1).all(dim=1)).all():
            raise ValueError(
                f"{row} on {sequence}, window {int((~finite).nonzero()[0])}: it predicted values that are not "
                f"numbers; the method, its weights or the events are damaged"
            )
    dolp = dequantise("dolp", quantise("dolp", prediction.dolp))
    aolp, log_variance = prediction.aolp, prediction.log_variance
    return Prediction(
        dolp,
        None if aolp is None else dequantise("aolp", quantise("aolp", aolp.remainder(torch.pi))),
        None if log_variance is None else log_variance.clamp(LOWEST, HIGHEST).half().float(),
    )


def _spread(scenes: Mapping[str, str], count: int) -> set[str]:
    """First sequence of each of `count` scenes, spread evenly over the split, both ends included; `scenes` by name."""
    first = list({scenes[name]: name for name in reversed([*scenes])}.values())[::-1]
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


def panel_of(sequence: TestSequence, predictions: Mapping[str, Prediction], warmup_windows: int) -> Panel:
    """Panel of the middle scored window, with a film of windows spread evenly over the scored ones."""
    scored, windows = scored_windows(sequence, warmup_windows), sequence.windows
    k = scored[len(scored) // 2]
    count = min(MAX_FILM_FRAMES, len(scored))
    film = [scored[round(i * (len(scored) - 1) / max(count - 1, 1))] for i in range(count)]
    counts = [torch.stack([polarity_sums(channel) for channel in windows[one].channels]).sum(0) for one in film]

    def shown(maps: Prediction) -> Shown:
        dolp, aolp = maps.dolp, maps.aolp
        angles = (None, None) if aolp is None else (aolp[k], angle_bytes(aolp[film]))
        return Shown(dolp[k], angles[0], fraction_bytes(dolp[film]), angles[1])

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
