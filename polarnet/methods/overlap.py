"""Run a method over the windows of a stream, whether they overlap or not.

Networks are trained on consecutive windows, 1/30 s long in the paper; their state summarises all earlier windows.
For DoLP at a higher rate, shorter windows would change the kind of input. Passing the state between overlapping
windows would count most events many times. A window therefore starts from the newest state whose window ended no
later than this window starts.

Consecutive windows pass their state on directly. If windows of length n S start every S, each window continues the
window n steps earlier, as if n cameras ran with shifted windows. Every event then counts exactly once in each of
these n series. If the step does not divide the length, events in the gap before a window are missed.
"""

import itertools
from collections.abc import Sequence

from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Recoverer, State
from polarnet.stokes import Prediction

STATES_PER_WINDOW = 64
"""Maximum number of states per window length; with finer steps, up to 1/64 of a window is missed."""
BEFORE_ALL_US = -(2**63)

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
