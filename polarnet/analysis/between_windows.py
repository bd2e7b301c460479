"""Frames between the ends of windows, for scoring: the last frame carried on by motion and events, or held."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from polarnet.benchmark.sequences import TestSequence
from polarnet.methods.between import BetweenConfig, anchored, carried
from polarnet.methods.method import Recoverer, clamped
from polarnet.stokes import Prediction


class FramesBetween(NamedTuple):
    """Predictions for one sequence, on the CPU."""

    at_ends: Prediction
    """A frame at the end of each window."""
    carried: Prediction
    """A frame at each of the other times (`polarnet.methods.between`)."""
    held: Prediction
    """At those times, the frame of the last window that had ended."""


@torch.no_grad()
def frames_between(
    sequence: TestSequence, t_us: Sequence[int], recoverer: Recoverer, config: BetweenConfig
) -> FramesBetween:
    """Predict a frame at the end of each window, and carry the last one on to each of the increasing times `t_us`.

    The method runs once over the windows of the sequence. ValueError for a time before the end of the first window.
    """
    windows = sequence.windows
    if t_us[0] < windows[0].stop_us:
        raise ValueError(f"expected times from the end of the first window, {windows[0].stop_us} us, got {t_us[0]} us")
    first = windows[0].channels[0]
    state, before = recoverer.start(first.height, first.width), None
    at_ends, on, held = [], [], []
    for window, end_us in zip(windows, [*(next_.stop_us for next_ in windows[1:]), t_us[-1] + 1], strict=True):
        state, prediction = recoverer.step(state, [window])
        frame = Prediction(*(None if field is None else field[0].cpu() for field in prediction))  # type: ignore[arg-type]
        before = anchored(before, window, frame, config)
        at_ends.append(frame)
        for time_us in (t for t in t_us if window.stop_us <= t < end_us):
            before, later = carried(before, sequence.events, time_us, config)
            on.append(later)
            held.append(frame)
    return FramesBetween(_joined(at_ends), _joined(on), _joined(held))


def _joined(frames: Sequence[Prediction]) -> Prediction:
    """DoLP, AoLP and log-variance of several frames, stacked."""
    maps = [None if fields[0] is None else torch.stack(fields) for fields in list(zip(*frames, strict=True))[:3]]
    return clamped(Prediction(*maps))  # type: ignore[arg-type]
