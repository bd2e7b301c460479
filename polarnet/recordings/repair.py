"""Repair a file's blocks: events end up in time order, on the sensor and of polarity +1 or -1, or the file is refused.

Every repair is counted. The outcome depends on the file alone, not on the block size.
"""

from collections import Counter
from collections.abc import Iterator
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool

from polarnet.recordings.source import REPAIRS, SAFE, Block, RecordingError, Source, joined

LATE_US = 10_000
"""Events late by at most this are put in order: packets overtake each other, clocks do not."""
PAUSE_US = 1_000_000  # longer pauses are counted
LOOKAHEAD = 8  # following events that distinguish a wrong time from a clock that was reset
MAX_HELD = 2**22  # events held back to wait for late ones
TOLERATED_SHARE = 0.01  # accepted share of a file's events, per kind of damage
TOLERATED_COUNT = 8  # accepted count in files too short for a share
HARMLESS = ("no_change", "unsorted", "pauses")
FIRST_PAUSE_US = 3_600_000_000  # a longer pause right after the first event means that the first event's time is wrong
MAX_TIME = 2**60  # microseconds; differences still fit into int64


NOTHING = Block(np.empty(0, np.int64), *(np.empty(0, dtype) for dtype in (np.int16, np.int16, np.int8)))


def repaired(name: str, source: Source, counts: Counter[str]) -> Iterator[Block]:
    """The events of a source, t as int64, x and y as int16, p as int8; repairs are added to `counts`.

    RecordingError, beginning with `name`, where damage is not safe to repair: more than 1 % of the events (and 8) of
    one kind, or a time that goes back by more than 10 ms and stays there.
    """
    clock = _Clock(name)
    darker: int | None = None
    events = 0
    for block in source.blocks(counts):
        events += len(block.t)
        darker = _darker(block.p) if darker is None else darker
        for column in (block.x, block.y):
            if column.dtype.kind == "f" and not np.equal(column, np.floor(column)).all():
                raise RecordingError(f"{name}: expected x and y to be whole numbers")
        good = usable(block, source.height, source.width, darker, counts)
        yield clock.ordered(_typed(block if good.all() else block.rows(good)), counts, last=False)
        refuse_much_damage(name, counts, events)
    yield clock.ordered(NOTHING, counts, last=True)
    refuse_much_damage(name, counts, events)
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


def refuse_much_damage(name: str, counts: Counter[str], events: int) -> None:
    """RecordingError if more than 1 % of the events (and 8) have the same damage, unless it is `SAFE`."""
    for kind, words in REPAIRS.items():
        if kind not in SAFE and counts[kind] > max(TOLERATED_COUNT, TOLERATED_SHARE * events):
            raise RecordingError(
                f"{name}: {counts[kind]} among the first {events} events: {words.split(':')[0]}; "
                f"so much damage is not repaired. Is the format right, and the size of the sensor?"
            )


def _typed(block: Block) -> Block:
    x, y = (column.astype(np.int16, copy=False) for column in (block.x, block.y))
    return Block(block.t.astype(np.int64, copy=False), x, y, np.where(block.p == 1, np.int8(1), np.int8(-1)))


class _Clock:
    """Sorts late events into place, and holds back the last few events until their times can be judged."""

    def __init__(self, name: str):
        self.name = name
        self.judged = 0
        self.newest: int | None = None
        self.floor = -MAX_TIME
        self.unjudged = self.held = NOTHING

    def ordered(self, block: Block, counts: Counter[str], *, last: bool) -> Block:
        """Events in time order that no later event can precede."""
        block = joined([self.unjudged, block])
        count = len(block.t) if last else max(0, len(block.t) - LOOKAHEAD)
        keep = np.ones(count, np.bool_)
        started = self.newest is not None
        newest, glitches, unsorted, pauses, refused = _judge(block.t, keep, self.newest or 0, started, self.floor)
        if refused >= 0:
            t_us = int(block.t[refused])
            raise RecordingError(
                f"{self.name}: after event {self.judged + refused}, time goes back by {newest - t_us} us, from "
                f"{newest} to {t_us} us, and stays there: the camera's clock was set anew, or recordings were joined; "
                f"cut the file there"
            )
        counts.update({"time_glitches": int(glitches), "unsorted": int(unsorted), "pauses": int(pauses)})
        self.judged += count
        self.unjudged = block.rows(slice(count, None))
        accepted = block.rows(slice(count))
        if glitches:
            accepted = accepted.rows(keep)
        if len(accepted.t):
            self.newest = int(newest)
        accepted = joined([self.held, accepted])
        if unsorted:
            accepted = accepted.rows(np.argsort(accepted.t, kind="stable"))
        ready = len(accepted.t) if last else self._ready(accepted)
        self.held = accepted.rows(slice(ready, None))
        return accepted.rows(slice(ready))

    def _ready(self, accepted: Block) -> int:
        """Number of events more than `LATE_US` older than the newest; half of all if too many would be held back."""
        ready = int(np.searchsorted(accepted.t, (self.newest or 0) - LATE_US))
        if len(accepted.t) - ready > MAX_HELD:
            ready = len(accepted.t) // 2
            self.floor = int(accepted.t[ready - 1])
        return ready


@numba.njit(nogil=True, cache=True)
@no_type_check
def _judge(t, keep, newest, started, floor):
    """Mark the events with credible times in `keep`.

    Returns the newest time, the counts of glitches, late events and pauses, and the index of the refused event or -1.
    """
    glitches, unsorted, pauses = 0, 0, 0
    for i in range(len(keep)):
        now = t[i]
        earliest = max(newest - LATE_US, floor)
        if started and earliest <= now <= newest + LATE_US:
            if now < newest:
                unsorted += 1
            else:
                newest = now
            continue
        representable = -MAX_TIME < now < MAX_TIME
        after = t[i + 1 : i + 1 + LOOKAHEAD]
        if not started or now > newest:
            otherwise = 0
            for later in after:
                if (later < now - LATE_US and (not started or later >= earliest)) or (
                    not started and later > now + FIRST_PAUSE_US
                ):
                    otherwise += 1
            if representable and 2 * otherwise <= len(after):
                pauses += started and now - newest > PAUSE_US
                newest, started = now, True
                continue
        elif representable:
            otherwise = 0
            for later in after:
                if later >= earliest:
                    otherwise += 1
            if 2 * otherwise < len(after):
                return newest, glitches, unsorted, pauses, i
        keep[i] = False
        glitches += 1
    return newest, glitches, unsorted, pauses, -1
