"""Run a method over windows of any length, whether they overlap or not.

For DoLP at a higher rate, windows overlap. Passing the state from each to the next would count most events many times.
A window therefore starts from the newest state whose window ended no later than this window starts (`advance`). If
windows of length n S start every S, each continues the window n steps earlier, as if n cameras ran with shifted
windows. If the step does not divide the length, events in the gap before a window are missed.

The sums, recurrent layers and gains of a network fit the window length of its training (`of_any_length`). Shorter
windows are joined with earlier ones up to about that length, and longer windows are cut into parts of that length.
Windows that were joined because a processor did not keep up (`EventWindow.joined`) stay whole, which takes one step.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from polarnet.events.stream import Events, slice_time
from polarnet.events.streaming import EventWindow, join_windows
from polarnet.methods.method import Recoverer, State, each_map, joined
from polarnet.stokes import Prediction

STATES_PER_WINDOW = 64
"""Maximum number of states per window length; with finer steps, up to 1/64 of a window is missed."""
BEFORE_ALL_US = -(2**63)
SAME = 1.5  # windows whose length is the trained one within this factor are used as they are

History = tuple[tuple[int, State], ...]
"""Pairs of a window's end (microseconds) and the state after that window, oldest first."""


def begin(recoverer: Recoverer, height: int, width: int) -> History:
    """History before the first event."""
    return ((BEFORE_ALL_US, recoverer.start(height, width)),)


def advance(recoverer: Recoverer, history: History, windows: Sequence[EventWindow]) -> tuple[History, Prediction]:
    """History and n predicted frames after n consecutive windows, which may overlap windows of earlier calls.

    ValueError unless each window starts at the end of the previous one.
    """
    spans = [(window.start_us, window.stop_us) for window in windows]
    if any(stop != start for (_, stop), (start, _) in itertools.pairwise(spans)):
        raise ValueError(f"expected windows that follow each other, got {spans} us")
    last = windows[-1]
    if recoverer.takes_events_once:
        state, prediction = recoverer.step(history[-1][1], windows)
        return ((last.stop_us, state),), prediction
    while len(history) > 1 and history[1][0] <= windows[0].start_us:
        history = history[1:]
    state, prediction = recoverer.step(history[0][1], windows)
    if (last.stop_us - history[-1][0]) * STATES_PER_WINDOW >= last.length_us:
        history = (*history, (last.stop_us, state))
    return history, prediction


def warm_up(recoverer: Recoverer, height: int, width: int, channels: int = 4) -> None:
    """Run two empty windows, so that kernels are loaded before the first real window."""
    nothing = [Events.empty(height, width)] * channels
    state = recoverer.start(height, width)
    for k in range(2):  # without and with a state
        state, _ = recoverer.step(state, [EventWindow(nothing, 1000 * k, 1000 * (k + 1))])


class Recent(NamedTuple):
    """State of `of_any_length` between windows."""

    history: History
    windows: tuple[EventWindow, ...]
    """Latest windows, together about as long as those of the training; empty unless they are shorter."""


def of_any_length(recoverer: Recoverer, trained_us: int) -> Recoverer:
    """Wrap a method trained on windows of `trained_us` microseconds, for windows of any length."""

    def start(height: int, width: int) -> Recent:
        return Recent(begin(recoverer, height, width), ())

    def fits(window: EventWindow) -> bool:
        return trained_us / SAME <= window.length_us <= (math.inf if window.joined > 1 else trained_us * SAME)

    def predict(state: Recent, windows: Sequence[EventWindow]) -> tuple[Recent, Prediction]:
        if all(map(fits, windows)):
            history, prediction = advance(recoverer, state.history, windows)
            return Recent(history, ()), prediction
        frames = []
        for window in windows:
            parts, recent = equal_parts(window, trained_us), _recent(state.windows, window, trained_us)
            if len(parts) == 1:
                parts = [join_windows(recent)]
            history, prediction = advance(recoverer, state.history, parts)
            state = Recent(history, recent)
            frames.append(each_map(prediction, lambda field: field[-1]))
        return state, joined(frames, torch.stack)

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


def equal_parts(window: EventWindow, part_us: int) -> list[EventWindow]:
    """Cut a window into equal parts of about `part_us`."""
    number = max(1, round(window.length_us / part_us))
    ends = [window.start_us + round(k * window.length_us / number) for k in range(number + 1)]
    return [
        EventWindow([slice_time(events, start, stop) for events in window.channels], start, stop)
        for start, stop in itertools.pairwise(ends)
    ]
