"""Rows of the benchmark: references and methods, and running them over a sequence."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from polarnet.benchmark.sequences import TestSequence
from polarnet.events.streaming import EventWindow
from polarnet.methods import METHODS, ROWS
from polarnet.methods.method import Method, Recoverer, Setup, each_map, joined, weights_record, why_absent
from polarnet.metrics.references import REFERENCES
from polarnet.stokes import Prediction
from polarnet.terminal.progress import steps

MAX_OPEN = 32
"""Maximum number of methods whose weights stay in memory between sequences."""


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
            method = METHODS[name]
            prediction = predicted_over(opened(method, context), sequence.windows_for(method.rotating))
        predictions[name] = each_map(prediction, Tensor.cpu)
        for maps in prediction:
            if maps is not None and not (finite := maps.isfinite().flatten(1).all(1)).all():
                raise ValueError(
                    f"{name} on {sequence.name}, window {int((~finite).nonzero()[0])}: it predicted values that are "
                    f"not numbers; the method, its weights or the events are damaged"
                )
    return predictions


def predicted_over(recoverer: Recoverer, windows: Sequence[EventWindow]) -> Prediction:
    """DoLP, AoLP and expected error over consecutive windows, one at a time as from a camera, or as from a file."""
    first = windows[0].channels[0]
    state = recoverer.start(first.height, first.width)
    at_once = recoverer.at_once(first.height, first.width) if recoverer.sees_ahead else 1
    frames = []
    for k in range(0, len(windows), at_once):
        state, prediction = recoverer.step(state, windows[k : k + at_once])
        frames.append(prediction._replace(stokes=None, intensities=None))
    return joined(frames)


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
