"""Repair a file's blocks: events end up in time order, on the sensor and of polarity +1 or -1, or the file is refused.

Every repair is counted. The outcome depends on the file alone, not on the block size.
"""

from collections import Counter
from collections.abc import Iterator
from typing import no_type_check

import numba
import numpy as np

from polarnet.recordings.source import REPAIRS, SAFE, Block, RecordingError, Source

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
        if darker is None:
            darker = _darker(block.p)
        usable = _on_sensor(name, _with_sign(block, darker, counts), source, counts)
        yield from _filled(clock.ordered(usable, counts, last=False))
        _refuse_much_damage(name, counts, events)
    nothing = Block(np.empty(0, np.int64), *(np.empty(0, dtype) for dtype in (np.int16, np.int16, np.int8)))
    yield from _filled(clock.ordered(nothing, counts, last=True))
    _refuse_much_damage(name, counts, events)
    damage = {kind: count for kind, count in counts.items() if count and kind not in HARMLESS}
    if damage and events == 0:
        raise RecordingError(f"{name}: no event can be read in it: {damage}; is the format right?")


def _filled(block: Block) -> Iterator[Block]:
    if len(block.t):
        yield block


def _darker(p: np.ndarray) -> int | None:
    """The value that stands for darker, 0 or -1: the more frequent one; None where neither occurs."""
    zeros, minus_ones = np.count_nonzero(p == 0), np.count_nonzero(p == -1)
    return None if zeros == minus_ones == 0 else -1 if minus_ones > zeros else 0


def _with_sign(block: Block, darker: int | None, counts: Counter[str]) -> Block:
    brighter = block.p == 1
    known = brighter if darker is None else brighter | (block.p == darker)
    bad = len(known) - np.count_nonzero(known)
    if bad:
        counts["bad_polarity"] += int(bad)
        block, brighter = _select(block, known), brighter[known]
    return block._replace(p=np.where(brighter, np.int8(1), np.int8(-1)))


def _on_sensor(name: str, block: Block, source: Source, counts: Counter[str]) -> Block:
    for axis in "xy":
        column = getattr(block, axis)
        if column.dtype.kind == "f" and not np.equal(column, np.floor(column)).all():
            raise RecordingError(f"{name}: expected x and y to be whole numbers")
    inside = (block.x >= 0) & (block.x < source.width) & (block.y >= 0) & (block.y < source.height)
    outside = len(inside) - np.count_nonzero(inside)
    if outside:
        counts["out_of_range"] += int(outside)
        block = _select(block, inside)
    return block._replace(
        t=block.t.astype(np.int64, copy=False),
        x=block.x.astype(np.int16, copy=False),
        y=block.y.astype(np.int16, copy=False),
    )


def _refuse_much_damage(name: str, counts: Counter[str], events: int) -> None:
    for kind, words in REPAIRS.items():
        if kind not in SAFE and counts[kind] > max(TOLERATED_COUNT, TOLERATED_SHARE * events):
            raise RecordingError(
                f"{name}: {counts[kind]} among the first {events} events: {words.split(':')[0]}; "
                f"so much damage is not repaired. Is the format right, and the size of the sensor?"
            )


def _select(block: Block, which: np.ndarray) -> Block:
    return Block(*(column[which] for column in block))


class _Clock:
    """Sorts late events into place, and holds back the last few events until their times can be judged."""

    def __init__(self, name: str):
        self.name = name
        self.judged = 0
        self.newest: int | None = None
        self.floor = -MAX_TIME
        self.unjudged: Block | None = None
        self.held: Block | None = None

    def ordered(self, block: Block, counts: Counter[str], *, last: bool) -> Block:
        """Events in time order that no later event can precede."""
        if self.unjudged is not None:
            block = Block(*map(np.concatenate, zip(self.unjudged, block, strict=True)))
        count = len(block.t) if last else max(0, len(block.t) - LOOKAHEAD)
        keep = np.ones(count, np.bool_)
        started = self.newest is not None
        newest, glitches, unsorted, pauses, refused = _judge(block.t, keep, self.newest or 0, started, self.floor)
        if refused >= 0:
            self._refuse(int(block.t[refused]), int(newest), self.judged + int(refused))
        counts.update({"time_glitches": int(glitches), "unsorted": int(unsorted), "pauses": int(pauses)})
        self.judged += count
        self.unjudged = Block(*(column[count:] for column in block))
        accepted = Block(*(column[:count] for column in block))
        if glitches:
            accepted = _select(accepted, keep)
        if len(accepted.t):
            self.newest = int(newest)
        return self._release(accepted, in_order=unsorted == 0, last=last)

    def _release(self, accepted: Block, *, in_order: bool, last: bool) -> Block:
        if self.held is not None and len(self.held.t):
            accepted = Block(*map(np.concatenate, zip(self.held, accepted, strict=True)))
        if not in_order:
            accepted = _select(accepted, np.argsort(accepted.t, kind="stable"))
        count = len(accepted.t)
        if count and not last:
            count = int(np.searchsorted(accepted.t, (self.newest or 0) - LATE_US))
            if len(accepted.t) - count > MAX_HELD:
                count = len(accepted.t) // 2
                self.floor = int(accepted.t[count - 1])
        self.held = Block(*(column[count:] for column in accepted))
        return Block(*(column[:count] for column in accepted))

    def _refuse(self, t_us: int, newest_us: int, place: int) -> None:
        raise RecordingError(
            f"{self.name}: after event {place}, time goes back by {newest_us - t_us} us, from {newest_us} to {t_us} "
            f"us, and stays there: the camera's clock was set anew, or recordings were joined; cut the file there"
        )


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
