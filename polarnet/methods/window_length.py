"""Windows of any length for a network that was trained on one length.

The sums, recurrent layers and gains of a network fit the window length of its training. Shorter windows are therefore
joined with earlier windows up to about that length, and longer windows are cut into parts of about that length. The
method still returns one frame for each window it is given. Joined windows overlap and continue earlier states as in
`polarnet.methods.overlap`.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch

from polarnet.events.stream import concatenate, slice_time
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Recoverer, each_map
from polarnet.methods.overlap import History, advance, begin
from polarnet.stokes import Prediction

SAME = 1.5  # windows whose length is the trained one within this factor are used as they are


class Recent(NamedTuple):
    """State between windows."""

    history: History
    windows: tuple[EventWindow, ...]
    """Latest windows, together about as long as those of the training; empty unless they are shorter."""


def of_any_length(recoverer: Recoverer, trained_us: int) -> Recoverer:
    """Wrap a method trained on windows of `trained_us` microseconds, for windows of any length."""

    def start(height: int, width: int) -> Recent:
        return Recent(begin(recoverer, height, width), ())

    def predict(state: Recent, windows: Sequence[EventWindow]) -> tuple[Recent, Prediction]:
        if all(trained_us / SAME <= window.length_us <= trained_us * SAME for window in windows):
            history, prediction = advance(recoverer, state.history, windows)
            return Recent(history, ()), prediction
        frames = []
        for window in windows:
            parts, recent = _parts(window, trained_us), _recent(state.windows, window, trained_us)
            if len(parts) == 1:
                parts = [_joined(recent)]
            history, prediction = advance(recoverer, state.history, parts)
            state = Recent(history, recent)
            frames.append(each_map(prediction, lambda field: field[-1]))
        fields = zip(*frames, strict=True)
        maps = [None if field[0] is None else torch.stack(field) for field in fields]
        return state, Prediction(*maps)  # type: ignore[arg-type]

    return recoverer._replace(start=start, predict=predict)


def _recent(before: Sequence[EventWindow], window: EventWindow, trained_us: int) -> tuple[EventWindow, ...]:
    """Return the latest windows without gaps whose joint length is nearest to `trained_us`, at least the last one."""
    last = [window]
    for earlier in reversed(before):
        more = window.stop_us - earlier.start_us
        if earlier.stop_us != last[0].start_us or more - trained_us > trained_us - (window.stop_us - last[0].start_us):
            break
        last.insert(0, earlier)
    return tuple(last)


def _joined(windows: Sequence[EventWindow]) -> EventWindow:
    channels = [concatenate(parts) for parts in zip(*(window.channels for window in windows), strict=True)]
    return EventWindow(channels, windows[0].start_us, windows[-1].stop_us)


def _parts(window: EventWindow, trained_us: int) -> list[EventWindow]:
    """Cut a window into equal parts of about `trained_us`."""
    number = max(1, round(window.length_us / trained_us))
    ends = [window.start_us + round(k * window.length_us / number) for k in range(number + 1)]
    if number == 1:
        return [window]
    return [
        EventWindow([slice_time(events, start, stop) for events in window.channels], start, stop)
        for start, stop in itertools.pairwise(ends)
    ]
