"""`polarnet recover --rate`: frames at a fixed rate; between windows, motion and events update the last frame."""

import operator
import time
from collections.abc import Generator, Iterator, Sequence
from typing import NamedTuple

from torch import Tensor

from polarnet.events.stream import Events, concatenate, slice_time
from polarnet.events.streaming import SHORTEST_STEP_US, EventWindow, WindowCutter, WindowRule
from polarnet.methods.between import Between, BetweenConfig, anchored, carried
from polarnet.methods.method import Recoverer, each_map
from polarnet.methods.overlap import advance, begin, warm_up
from polarnet.recordings.arrangements import Piece
from polarnet.recovery.stream import Frame, Input, runs_of
from polarnet.stokes import POLARIZER_ANGLES_DEG

POLARIZERS = len(POLARIZER_ANGLES_DEG)
MAX_HZ = 1_000_000 / SHORTEST_STEP_US


class Rate(NamedTuple):
    """Frames at multiples of 1 / `hz` seconds, from the end of the first window on."""

    hz: float
    between: BetweenConfig

    def time_us(self, number: int) -> int:
        """Time of a frame, to the nearest microsecond."""
        return round(1e6 * number / self.hz)

    def number_from(self, t_us: int) -> int:
        """Number of the first frame at or after a time."""
        number = int(t_us * self.hz / 1e6)
        return number if self.time_us(number) >= t_us else number + 1


def check_rate(rate_hz: float, rule: WindowRule, recoverer: Recoverer) -> None:
    """ValueError for a rate out of range or beside a --step, or one that windows or a --step reach as cheaply."""
    if not 0 < rate_hz <= MAX_HZ:
        raise ValueError(f"--rate: expected more than 0 and at most {MAX_HZ:,.0f} frames a second, got {rate_hz:g}")
    if rule.step_us is not None:
        raise ValueError(
            "--rate and --step: expected one of them; --step runs the method for each frame, --rate once a window"
        )
    if recoverer.takes_events_once:
        step_ms = max(SHORTEST_STEP_US / 1000, 1000 / rate_hz)
        raise ValueError(
            f"--rate: expected a network; this method uses each event once, so frames are as cheap with "
            f"--step {step_ms:.3g}ms"
        )
    if rule.length_us is not None and rate_hz * rule.length_us <= 1_000_000:
        raise ValueError(
            f"--rate: expected more than the {1_000_000 / rule.length_us:.4g} frames a second that windows of "
            f"{rule.length_us / 1000:g} ms give, got {rate_hz:g}; leave it out, or lower it with a longer --window"
        )


def frames_at_rate(source: Input, rule: WindowRule, recoverer: Recoverer, rate: Rate) -> Iterator[Frame]:
    """Yield the frames of a rate, each as soon as its last event has arrived and its window has been processed.

    The method runs once a window, as in `frames_of`. The window of a frame, whose events the pictures show, ends at the
    time of the frame and is as long as the method's last window.
    """
    if source.channels != POLARIZERS:
        raise ValueError(
            f"--rate: expected the events behind four polarizers, {source.name} has one channel; leave it out"
        )
    warm_up(recoverer, source.height, source.width)
    cutter = WindowCutter(rule, source.height, source.width)
    history = begin(recoverer, source.height, source.width)
    most = recoverer.at_once(source.height, source.width)
    held: Sequence[Events] = [Events.empty(source.height, source.width)] * POLARIZERS
    state, number = None, 0
    for piece in source.pieces:
        held = [concatenate([old, new]) for old, new in zip(held, piece.channels, strict=True)]
        for windows in runs_of(cutter.add(piece.channels, piece.until_us), most):
            history, prediction = advance(recoverer, history, windows)
            maps = each_map(prediction, Tensor.cpu)
            for k, window in enumerate(windows):
                state, number = yield from _carried_until(window.stop_us, state, number, held, piece, rate)
                state = anchored(state, window, each_map(maps, operator.itemgetter(k)), rate.between)
                number = rate.number_from(window.stop_us)
                held = [slice_time(events, window.start_us, piece.until_us) for events in held]
        state, number = yield from _carried_until(piece.until_us + 1, state, number, held, piece, rate)


def _carried_until(
    until_us: int, state: Between | None, number: int, held: Sequence[Events], piece: Piece, rate: Rate
) -> Generator[Frame, None, tuple[Between | None, int]]:
    """Yield the frames from `number` on that lie before a time; return the state and the number of the next frame."""
    while state is not None and (t_us := rate.time_us(number)) < until_us:
        start = time.perf_counter()
        state, prediction = carried(state, held, t_us, rate.between)
        done = time.perf_counter()
        from_us = t_us - state.window.length_us
        window = EventWindow([slice_time(events, from_us, t_us) for events in held], from_us, t_us)
        yield Frame(window, prediction, done - start, done - piece.read_at)
        number += 1
    return state, number
