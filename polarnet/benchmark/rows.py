"""Rows of the benchmark: references and methods, running them over a sequence, and their cost on this machine."""

import functools
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from polarnet.benchmark.score import Cost
from polarnet.benchmark.sequences import TestSequence
from polarnet.methods import METHODS, ROWS
from polarnet.methods.method import Method, Recoverer, Setup, each_map, weights_record, why_absent
from polarnet.metrics.references import REFERENCES
from polarnet.stokes import Prediction
from polarnet.terminal.progress import steps

MAX_OPEN = 32
"""Maximum number of methods whose weights stay in memory between sequences."""
COUNTED_WINDOWS = 3  # windows to count arithmetic over: enough for the state to be passed on
TIMED_WINDOWS = 6
REPEATS = 3  # number of timings; the median is reported


@dataclass(frozen=True)
class Context:
    """Inputs of the rows besides the sequence."""

    train_mean: float | None
    """Mean DoLP of the training split; None without a training split."""
    setups: Mapping[str, Setup]
    """Setup by section of `methods` in params.yaml, which NAME+gain shares with NAME."""
    device: torch.device
    """Device that computes the scores."""


@torch.no_grad()
def predictions_of(names: Sequence[str], sequence: TestSequence, context: Context) -> dict[str, Prediction]:
    """Prediction by row, one frame per window, on the CPU; ValueError for a value that is no number."""
    predictions = {}
    for name in steps(names):
        if name in REFERENCES:
            prediction = REFERENCES[name].predict(sequence.dolp, sequence.valid, context.train_mean)
        else:
            method, size = METHODS[name], sequence.dolp.shape[-2:]
            recoverer = opened(method, context)
            at_once = recoverer.at_once(*size) if recoverer.between else 1  # one at a time as from a camera, or a file
            _, prediction = recoverer.run(recoverer.start(*size), sequence.windows(method.rotating), at_once)
            prediction = prediction._replace(stokes=None, intensities=None)
        predictions[name] = each_map(prediction, Tensor.cpu)
        for maps in prediction:
            if maps is not None and not (finite := maps.isfinite().flatten(1).all(1)).all():
                raise ValueError(
                    f"{name} on {sequence.name}, window {int((~finite).nonzero()[0])}: it predicted values that are "
                    f"not numbers; the method, its weights or the events are damaged"
                )
    return predictions


def opened(method: Method, context: Context) -> Recoverer:
    """The method, ready to run; cached while its settings and weights file are unchanged."""
    setup = context.setups[method.section]
    written = setup.weights.stat().st_mtime_ns if setup.weights is not None and setup.weights.exists() else None
    return _opened(method, setup, written)


@functools.lru_cache(maxsize=MAX_OPEN)
def _opened(method: Method, setup: Setup, written: int | None) -> Recoverer:
    return method.open(setup)


def available(names: Sequence[str], context: Context) -> tuple[list[str], dict[str, str]]:
    """The rows that can run, in the given order, and the reasons for leaving out the others."""
    reasons = {}
    for name in names:
        row = ROWS[name]
        if isinstance(row, Method):
            if reason := why_absent(row, context.setups[row.section]):
                reasons[name] = reason
        elif row.needs_train_mean and context.train_mean is None:
            reasons[name] = "the training split is not there; run `dvc repro synthesize`"
    return [name for name in names if name not in reasons], reasons


def weights_used(names: Sequence[str], context: Context) -> dict[str, dict[str, str]]:
    """File name, sha256 and network of the weights, by section of `methods`, for the rows that need weights."""
    methods = [METHODS[name] for name in names if name in METHODS and METHODS[name].networks]
    return {method.section: weights_record(method, context.setups[method.section]) for method in methods}


def cost_of(row: str, sequence: TestSequence, context: Context) -> Cost:
    """Measure a row on the first windows of a sequence, several times; the first call is not timed."""
    from torch.utils.flop_counter import FlopCounterMode  # it takes a second to import

    recoverer = opened(METHODS[row], context) if row in METHODS else None
    network = recoverer.network if recoverer else None
    timed = recoverer.at_once(*sequence.dolp.shape[-2:]) if recoverer and recoverer.between else TIMED_WINDOWS
    few, many = first_windows(sequence, COUNTED_WINDOWS), first_windows(sequence, timed)
    predictions_of([row], few, context)  # compiles and allocates
    with FlopCounterMode(display=False) as flops:
        predictions_of([row], few, context)
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        predictions_of([row], many, context)
        seconds.append(time.perf_counter() - start)
    return Cost(
        ms_per_window=1000 * statistics.median(seconds) / len(many.dolp),
        gflop=flops.get_total_flops() / len(few.dolp) / 1e9 if network is not None else None,
        params=sum(p.numel() for p in network.parameters()) if network is not None else 0,
    )


def first_windows(sequence: TestSequence, count: int) -> TestSequence:
    """The first `count` windows of a sequence; all of it if it is shorter. Later events belong to no window."""
    frames = {name: getattr(sequence, name)[:count] for name in ("dolp", "aolp", "s0")}
    valid = None if sequence.valid is None else sequence.valid[:count]
    return replace(sequence, t_us=sequence.t_us[: count + 1], valid=valid, **frames)
