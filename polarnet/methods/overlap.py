"""Windows of a stream, overlapping or not, through a method.

Networks learn on windows that follow each other, 1/30 s long in the paper, and their state summarises all that came
before the present window. For DoLP more often than that, windows must not be shorter: they would hold another kind
of input. Neither may each hand its state to the next while they overlap: most events would count many times. A
window therefore begins with the newest state whose window ended no later than it begins.

Windows one after the other so have their state handed on. Of windows that overlap, every S-th of a length of n S, each
continues the one n before it, as if n cameras ran with shifted windows: no event counts twice, none is missed. A step
that does not divide the length leaves a gap before the window, whose events are missed.
"""

import itertools
from collections.abc import Sequence

from polarnet.events.stream import Events
from polarnet.events.streaming import EventWindow
from polarnet.methods.method import Recoverer, State
from polarnet.stokes import Prediction

STATES_PER_WINDOW = 64
"""At most this many states are kept for the length of a window: where steps are finer, up to a 64th is missed."""
BEFORE_ALL_US = -(2**63)

History = tuple[tuple[int, State], ...]
"""The end of a window (microseconds) and the state after it, oldest first."""


def begin(recoverer: Recoverer, height: int, width: int) -> History:
    """The history before the first event."""
    return ((BEFORE_ALL_US, recoverer.start(height, width)),)


def advance(recoverer: Recoverer, history: History, windows: Sequence[EventWindow]) -> tuple[History, Prediction]:
    """The history after n consecutive windows, which may overlap those of calls before, and n frames.

    ValueError where one of them does not begin where the one before ends.
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


def warm_up(recoverer: Recoverer, height: int, width: int) -> None:
    """Run two windows without events, so that the first real one does not wait for kernels to load."""
    nothing = [Events.empty(height, width)] * 4
    state = recoverer.start(height, width)
    for k in range(2):  # with and without a state
        state, _ = recoverer.step(state, [EventWindow(nothing, 1000 * k, 1000 * (k + 1))])
