"""Run every method on every sequence of a test set, score it, measure its cost and keep panels."""

import functools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor

from polarnet.benchmark.references import mean_dolp
from polarnet.benchmark.rows import Context, predictions_of
from polarnet.benchmark.score import BenchmarkConfig, Cost, FrameScore, score_sequence, scored_windows
from polarnet.benchmark.sequences import TestSequence
from polarnet.events.representations import event_tensor, polarity_sums
from polarnet.events.stream import slice_time
from polarnet.events.windows import encode_windows
from polarnet.metrics.reliability import HIGHEST, LOWEST, Reliability, reliability
from polarnet.metrics.similarity import Lpips
from polarnet.reports.film import angle_bytes, fraction_bytes, signed_bytes
from polarnet.stokes import Prediction
from polarnet.storage.events import EventStore
from polarnet.storage.frames import (
    FrameStore,
    dequantise_angle,
    dequantise_fraction,
    quantise_angle,
    quantise_fraction,
)

MAX_FILM_FRAMES = 12
"""Frames of the report's player for each scene; they keep a page of 50 scenes below 30 MB."""


@dataclass(frozen=True)
class Panel:
    """One window of one sequence and a film of its scored windows: events, truth, and predictions of rows."""

    sequence: str
    window: int
    t_us: int
    maps: Mapping[str, Shaped[Tensor, "..."]]
    """`events` (the four event tensors, Eq. 5), `truth_dolp`, `truth_aolp`, `truth_s0`; `dolp_ROW` and, if the row
    predicts it, `aolp_ROW`. The film has `film_t_us`, and the same maps as bytes over the frames, after `film_`:
    `film_events` is ON minus OFF of the four channels (128: none), `film_aolp_ROW` is 256 for pi."""

    def of_row(self, row: str) -> "Panel":
        """The same window with the predictions of one row."""
        predicted = ("dolp_", "aolp_", "film_dolp_", "film_aolp_")
        names = [name for name in self.maps if not name.startswith(predicted)]
        own = [prefix + row for prefix in predicted]
        maps = {name: self.maps[name] for name in (*names, *own) if name in self.maps}
        return replace(self, maps=maps)


@dataclass(frozen=True)
class Benchmark:
    """Results of one test set, or of one of its sequences."""

    rows: Sequence[FrameScore]
    costs: Mapping[str, Cost]
    panels: Sequence[Panel]
    reliability: Mapping[str, Reliability] = field(default_factory=dict)
    """Reliability of the expected errors, for the methods that predict them."""


@dataclass(frozen=True)
class BenchmarkSet:
    """Test sequences with their truth."""

    name: str
    events: EventStore
    frames: FrameStore
    rotating: EventStore | None = None
    """Events of one camera behind a rotating polarizer, in the first channel; None: no row needs them."""

    @property
    def sequences(self) -> list[str]:
        """Sequences of the test split, in the store's order; ValueError if there are none."""
        names = self.frames.of_split("test")
        if not names:
            raise ValueError(
                f"{self.frames.path} has no test sequence; raise ingest.test_fraction or ingest more pictures"
            )
        return names

    def sequence(self, name: str) -> TestSequence:
        """One sequence with its truth."""
        truth = self.frames.frames(name)
        i0, _, i90, _ = truth.intensity[1:].unbind(1)
        events = self.events.read(name)
        scene = self.frames.original_of(name)
        valid = None if truth.valid is None else truth.valid[1:]
        rotating = None if self.rotating is None else self.rotating.read(name)[0]
        s0 = i0 + i90
        return TestSequence(name, scene, events, truth.t_us, truth.dolp[1:], truth.aolp[1:], s0, valid, rotating)


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
    mapper: Callable[..., Iterable[Any]] = map,
) -> Benchmark:
    """Run and score `config.methods` on a test set; ValueError if it has no sequence.

    `mapper` is `polarnet.runtime.cluster.pmap` with its workers bound, or the built-in `map`; each task is one
    sequence. Costs are measured in this process, one method after another, on the first sequence.
    """
    from polarnet.benchmark.cost import cost_of  # torch's counter of operations takes a second to import

    names = test_set.sequences
    if lpips is not None:
        lpips = lpips.to(context.device)
    panels = _spread(names, config.panel_scenes, {name: test_set.frames.original_of(name) for name in names})
    task = functools.partial(
        _measured, test_set=test_set, context=context, config=config, lpips=lpips, panel_sequences=panels
    )
    results: list[Benchmark] = list(mapper(task, names))
    first = test_set.sequence(names[0])
    costs = {row: cost_of(row, first, context) for row in config.methods}
    sums: dict[str, Reliability] = {}
    for result in results:
        for method, here in result.reliability.items():
            sums[method] = sums[method] + here if method in sums else here
    rows = [row for result in results for row in result.rows]
    return Benchmark(rows, costs, [panel for result in results for panel in result.panels], sums)


def _measured(
    name: str,
    test_set: BenchmarkSet,
    context: Context,
    config: BenchmarkConfig,
    lpips: Lpips | None,
    panel_sequences: Collection[str],
) -> Benchmark:
    """Run and score every row on one sequence, which is read once; without costs."""
    sequence = test_set.sequence(name)
    predictions = {
        row: at_stored_precision(row, name, prediction)
        for row, prediction in predictions_of(config.methods, sequence, context).items()
    }
    rows = score_sequence(sequence, predictions, config.warmup_windows, lpips, context.device)
    panels = [_panel(sequence, predictions, config.warmup_windows)] if name in panel_sequences else []
    return Benchmark(rows, {}, panels, _reliability(sequence, predictions, config.warmup_windows))


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
    dolp = dequantise_fraction(quantise_fraction(prediction.dolp))
    aolp = log_variance = None
    if prediction.aolp is not None:
        aolp = dequantise_angle(quantise_angle(prediction.aolp.remainder(torch.pi)))
    if prediction.log_variance is not None:
        log_variance = prediction.log_variance.clamp(LOWEST, HIGHEST).half().float()
    return Prediction(dolp, aolp, log_variance)


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
    """Panel of the middle scored window, with a film of windows spread evenly over the scored ones."""
    windows = scored_windows(sequence, warmup_windows)
    k = windows[len(windows) // 2]
    count = min(MAX_FILM_FRAMES, len(windows))
    film = [windows[round(i * (len(windows) - 1) / max(count - 1, 1))] for i in range(count)]
    maps = {
        "events": encode_windows(sequence.events, sequence.t_us[k : k + 2], event_tensor)[0],
        "truth_dolp": sequence.dolp[k],
        "truth_aolp": sequence.aolp[k],
        "truth_s0": sequence.s0[k],
    } | _film_of_truth(sequence, film)
    for row, prediction in predictions.items():
        maps[f"dolp_{row}"] = prediction.dolp[k]
        maps[f"film_dolp_{row}"] = fraction_bytes(prediction.dolp[film])
        if prediction.aolp is not None:
            maps[f"aolp_{row}"] = prediction.aolp[k]
            maps[f"film_aolp_{row}"] = angle_bytes(prediction.aolp[film])
    return Panel(sequence.name, k, int(sequence.t_us[k + 1]), maps)


def _film_of_truth(sequence: TestSequence, film: Sequence[int]) -> dict[str, Tensor]:
    """Events and truth of the windows `film`, as bytes."""
    spans = [sequence.t_us[k : k + 2].tolist() for k in film]
    counts = [[polarity_sums(slice_time(events, *span)) for events in sequence.events] for span in spans]
    return {
        "film_t_us": sequence.t_us[[k + 1 for k in film]],
        "film_events": signed_bytes(torch.stack([torch.stack(channels).sum(0) for channels in counts])),
        "film_truth_s0": fraction_bytes(sequence.s0[film]),
        "film_truth_dolp": fraction_bytes(sequence.dolp[film]),
        "film_truth_aolp": angle_bytes(sequence.aolp[film]),
    }
