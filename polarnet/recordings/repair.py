"""Repair blocks of events: in time order, on the sensor and of polarity +1 or -1; or the file is refused.

Every repair is counted. The outcome of a file depends on the file alone, not on the block size.
"""

import logging
from collections import Counter
from collections.abc import Collection, Iterator

import numpy as np
from jaxtyping import Bool

from polarnet.events.streaming import MAX_PAUSE_US
from polarnet.recordings.source import REPAIRS, SAFE, Block, Blocks, Counts, RecordingError, joined
from polarnet.runtime.compilation import compiled

LATE_US = 10_000
"""Events late by at most this are put in order: packets overtake each other, clocks do not."""
PAUSE_US = 1_000_000  # longer pauses are counted
FEW = 8  # events: at least as many must follow on a clock before it is believed
MAX_RUN = 1000  # consecutive events with wrong times; a clock that shows another time for longer was set anew
MAX_STALE = 100  # events that a camera may still hold from its last run; `FEW` if the clock then jumps ahead
MAX_HELD = 2**22  # events held back to wait for late ones
TOLERATED_SHARE = 0.01  # accepted share of a file's events, per kind of damage
TOLERATED_COUNT = 8  # accepted count in files too short for a share
HARMLESS = ("no_change", "unsorted", "pauses")
MAX_TIME = 2**60  # microseconds; differences still fit into int64
NONE = -(2**62)  # before the first credible time
NEVER, UNKNOWN = -1, -2

NOTHING = Block(np.empty(0, np.int64), *(np.empty(0, dtype) for dtype in (np.int16, np.int16, np.int8)))

logger = logging.getLogger(__name__)


def repaired(
    name: str, blocks: Blocks, sensor: tuple[int, int], counts: Counts, bridged_us: int = 0
) -> Iterator[Block]:
    """The events on a sensor (height, width): t int64, x and y int16, p int8; repairs are added to `counts`.

    RecordingError, beginning with `name`, where damage is not safe to repair, after the events before it: more than 1 %
    of the events (and 8) of one kind, or a clock that was set anew `bridged_us` after the first event or later.
    """
    clock = Clock(name, counts, bridged_us=bridged_us)
    darker: int | None = None
    events = 0
    for block in blocks(counts):
        events += len(block.t)
        darker = _darker(block.p) if darker is None else darker
        for column in (block.x, block.y):
            if column.dtype.kind == "f" and not np.equal(column, np.floor(column)).all():
                raise RecordingError(f"{name}: expected x and y to be whole numbers")
        good = usable(block, *sensor, darker, counts)
        for ready in clock.ordered(_typed(block if good.all() else block.rows(good))):
            refuse_much_damage(name, counts, events)
            yield ready
    for ready in clock.ordered(NOTHING, final=True):
        refuse_much_damage(name, counts, events)
        yield ready
    damage = {kind: count for kind, count in counts.items() if count and kind not in HARMLESS}
    if damage and events == 0:
        raise RecordingError(f"{name}: no event can be read in it: {damage}; is the format right?")


def _darker(p: np.ndarray) -> int | None:
    """The value that stands for darker, 0 or -1: the more frequent one; None where neither occurs."""
    zeros, minus_ones = np.count_nonzero(p == 0), np.count_nonzero(p == -1)
    return None if zeros == minus_ones == 0 else -1 if minus_ones > zeros else 0


def usable(block: Block, height: int, width: int, darker: int | None, counts: Counter[str]) -> Bool[np.ndarray, " n"]:
    """Which events have a polarity, 1 or `darker`, and are on the sensor; the others are added to `counts`."""
    known = block.p == 1
    if darker is not None:
        known |= block.p == darker
    inside = (block.x >= 0) & (block.x < width) & (block.y >= 0) & (block.y < height)
    counts["bad_polarity"] += int(np.count_nonzero(~known))
    counts["out_of_range"] += int(np.count_nonzero(known & ~inside))
    return known & inside


def refuse_much_damage(name: str, counts: Counter[str], events: int, safe: Collection[str] = SAFE) -> None:
    """RecordingError if more than 1 % of the events (and 8) have the same damage, unless it is `safe`."""
    for kind, words in REPAIRS.items():
        if kind not in safe and counts[kind] > max(TOLERATED_COUNT, TOLERATED_SHARE * events):
            raise RecordingError(
                f"{name}: {counts[kind]} {words.split(':')[0]} ({events} events so far); so much damage is not "
                f"repaired. Is the format right, and the size of the sensor?"
            )


def _typed(block: Block) -> Block:
    x, y = (column.astype(np.int16, copy=False) for column in (block.x, block.y))
    return Block(np.ascontiguousarray(block.t, np.int64), x, y, np.where(block.p == 1, np.int8(1), np.int8(-1)))


class Clock:
    """Puts events in time order and leaves out those with wrong times: the one rule for files and live input.

    A time more than 10 ms before or after the newest one is judged by the events that follow it (docs/recordings.md has
    the cases). Repairs are added to `counts`. A clock that was set anew ends a file with a RecordingError; `live`
    input, and a file in the first `bridged_us`, go on as after a pause of 10 ms.
    """

    def __init__(self, name: str, counts: Counter[str], *, live: bool = False, bridged_us: int = 0):
        self.name = name
        self.counts = counts
        self._live, self._bridged_us = live, bridged_us
        self._settled = False  # whether stale events of the camera's last run can no longer come
        self._judged = self._dropped = 0
        self._first: int | None = None
        self._newest = NONE
        self._floor = -MAX_TIME
        self._shift_us = 0
        self._unjudged = self._held = NOTHING

    @property
    def waiting(self) -> bool:
        """Whether events are held back."""
        return len(self._unjudged.t) + len(self._held.t) > 0

    def ordered(self, block: Block, *, final: bool = False) -> Iterator[Block]:
        """Events in time order that no later event can precede, with those of the next block of the input.

        `final` judges all times by the events at hand: at the end, and where live input makes a pause.
        """
        shifted = block._replace(t=block.t + self._shift_us) if self._shift_us else block
        rest, held = joined([self._unjudged, shifted]), self._held
        while True:
            judged, reset, which = self._judge(rest, len(held.t), final)
            held, rest = joined([held, rest.rows(which)]), rest.rows(slice(judged, None))
            if not reset:
                break
            ahead = rest.t[0] > self._newest
            if not self._settled and self._judged <= (FEW if ahead else MAX_STALE):
                self.counts["stale"] += len(held.t)
                held, self._newest = NOTHING, NONE
            elif ahead and not self._live:
                self.counts["pauses"] += 1
                self._newest = int(rest.t[0])
            elif self._live or self._elapsed_us(held) < self._bridged_us:
                rest = self._set_anew(rest)
            else:
                self._settled = True
                yield self._ready(held, final=True)
                raise RecordingError(self._refusal(rest))
        self._unjudged = rest
        self._settled |= final or self._judged > MAX_STALE
        yield self._ready(held, final)

    def _judge(self, block: Block, before: int, final: bool) -> tuple[int, bool, np.ndarray | slice]:
        """Number of judged events, whether the next one sets the clock anew, and which of them to keep."""
        keep = np.ones(len(block.t), np.bool_)
        few = FEW if self._settled else min(FEW, before)
        state = self._newest, self._floor, self._dropped
        judged, reset, self._newest, self._dropped, counts = _judge(block.t, keep, *state, few, final)
        self._judged += judged
        self.counts.update(dict(zip(("time_glitches", "unsorted", "late", "pauses"), counts.tolist(), strict=True)))
        good = keep[:judged]
        return judged, reset, slice(judged) if good.all() else np.flatnonzero(good)

    def _ready(self, accepted: Block, final: bool) -> Block:
        """The events that can be handed on; the others are held back."""
        if not (np.diff(accepted.t) >= 0).all():
            accepted = accepted.rows(np.argsort(accepted.t, kind="stable"))
        ready = len(accepted.t)
        if not self._settled:
            ready = 0
        elif self._live:
            self._floor = max(self._floor, int(accepted.t[-1])) if ready else self._floor
        elif not final:
            ready = int(np.searchsorted(accepted.t, self._newest - LATE_US))
            if len(accepted.t) - ready > MAX_HELD:
                ready = len(accepted.t) // 2
                self._floor = int(accepted.t[ready - 1])
        if ready and self._first is None:
            self._first = int(accepted.t[0])
        self._held = accepted.rows(slice(ready, None))
        return accepted.rows(slice(ready))

    def _set_anew(self, rest: Block) -> Block:
        """The events of live input from a clock's reset on, 10 ms after the newest event."""
        shift_us = self._newest + LATE_US - int(rest.t[0])
        if not self.counts["clock_resets"]:
            logger.warning(
                "%s: after event %d, the camera's clock goes from %d to %d us: events go on as after a pause of %d ms; "
                "later resets are only counted",
                *(self.name, self._judged, self._newest - self._shift_us, int(rest.t[0]) - self._shift_us),
                LATE_US // 1000,
            )
        self.counts["clock_resets"] += 1
        self._shift_us += shift_us
        return rest._replace(t=rest.t + shift_us)

    def _elapsed_us(self, held: Block) -> int:
        """Time from the first event to the newest one."""
        return self._newest - (int(held.t.min(initial=self._newest)) if self._first is None else self._first)

    def _refusal(self, rest: Block) -> str:
        before, after = self._newest - self._shift_us, int(rest.t[0]) - self._shift_us
        elapsed_us, command = self._elapsed_us(NOTHING), f"polarnet convert {self.name} OUT"
        start = f" --start {self._bridged_us}us" if self._bridged_us else ""
        return (
            f"{self.name}: after event {self._judged}, time goes back by {before - after} us, from {before} to {after} "
            f"us, and stays there for {min(len(rest.t), MAX_RUN)} events: the camera's clock was set anew, or "
            f"recordings were joined. `{command}{start} --stop {elapsed_us + 1}us` writes the part before it, "
            f"`{command} --start {elapsed_us + LATE_US}us` the part after it"
        )


@compiled
def _judge(t, keep, newest, floor, dropped, few, final):
    """Mark the events with credible times in `keep`, up to one that needs events not yet there.

    Returns the number of judged events, whether the next one sets the clock anew, the newest credible time, the number
    of late events since then, and the counts of events far from the time of others, out of order, too late, and after a
    pause.
    """
    counts = np.zeros(4, np.int64)
    i = 0
    while i < len(t):
        now = t[i]
        if not -MAX_TIME < now < MAX_TIME:
            keep[i] = False
            counts[0] += 1
        elif newest == NONE:
            newest = now
        elif newest - LATE_US <= now <= newest + LATE_US:
            keep[i] = now >= floor
            counts[1] += floor <= now < newest
            counts[2] += now < floor
            newest = max(newest, now)
            dropped = 0
        else:
            ahead = now > newest
            other = not ahead or now - newest > MAX_PAUSE_US  # a clock, unless it is a glitch
            back = _back(t, i, max(newest - LATE_US, floor), now - LATE_US if ahead else MAX_TIME, final)
            if back == UNKNOWN:
                break
            if back == NEVER and other and final and dropped + len(t) - i <= min(few + i, FEW):
                dropped += len(t) - i
                back = len(t)
            if back == NEVER and other:
                return i, True, newest, 0, counts
            if back == NEVER:
                counts[3] += now - newest > PAUSE_US
                newest = now
                dropped = 0
            else:
                keep[i:back] = False
                counts[0] += back - i
                i = back - 1
        i += 1
    return i, False, newest, dropped, counts


@compiled
def _back(t, i, low, high, final):
    """Index of the event that brings time back into [low, high) after event `i`, for at least as long as it was away.

    It comes back by a jump: a clock that was set back catches up smoothly. NEVER if there is no such event among the
    next `MAX_RUN`, UNKNOWN if that takes events not yet there.
    """
    for j in range(i + 1, min(len(t), i + 1 + MAX_RUN)):
        if low <= t[j] < high and abs(float(t[j]) - float(t[j - 1])) > LATE_US:
            end = j + 1 + max(FEW, j - i)
            if end > len(t) and not final:
                return UNKNOWN
            inside, others = 0, 0
            for k in range(j + 1, min(end, len(t))):
                if low <= t[k] < high:
                    inside += 1
                else:
                    others += 1
            if inside >= others:
                return j
    return NEVER if final or len(t) > i + MAX_RUN else UNKNOWN
