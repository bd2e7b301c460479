"""Signs of a camera's readout in a recording: a limit that the event rate reaches, lost rows, late rows, gaps.

A readout at its limit hands out events, or rows of events, back to back: their spacing is even. Events of a scene are
spaced at random, so that the time of N of them varies by one part in the square root of N. Both are compared in the
busiest parts of the recording.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from polarnet.events.stream import Events

MARK_EVENTS = 32  # smallest number of events in a part, the events between two marks
MAX_MARKS = 2**18  # beyond it, every second mark is dropped
PARTS = 16  # consecutive parts in a block
MIN_BLOCKS = 4  # blocks of the top rate: fewer are no plateau
PLATEAU = 0.95  # share of the top rate from which a block belongs to the plateau
MAX_DISPERSION = 0.05  # of blocks at a limit; random events give (1 - u)^2 where the readout is busy for a share u
MAX_ROUNDING = 0.03  # dispersion that the clock's steps alone may cause
PARTS_PER_PIXEL = 8  # active pixels for each event of a part, at least: events of the same pixel are not random

ROW_READOUTS = 48  # mean readouts of a row in an interval of the search for lost rows
REACH = 8  # rows within which a lost row has neighbours
MIN_EXPECTED = 16  # readouts that a lost row should have had
MIN_LOST = 4  # cases: fewer are no evidence
BUSY_TO_QUIET = 4  # cases in intervals above the mean rate for each case in as many intervals below it

MIN_SWEEP_STEPS = 1000
SWEEP_SHARE = 0.9  # share of the steps that go the same way
MIN_SWEEP_ROWS_PER_US = 0.05  # 50,000 rows a second: nothing in a scene moves as fast

LONGEST_GAPS = 20
GAP_FACTOR = 10  # a gap is longer than all but one silence in a thousand by this factor
GAP_TO_OTHERS = 3  # and than the twentieth longest silence by this one
SILENCES_BELOW = 0.999


class Limit(NamedTuple):
    """A rate that the readout does not exceed."""

    unit: str
    """events or rows"""
    rate_hz: float
    time_share: float
    """Share of the recording's time at this rate."""
    dispersion: float
    """Variance of the duration of a part, relative to that of as many random events."""


class Sweep(NamedTuple):
    """Rows or columns that are read one after another."""

    axis: str
    """rows or columns"""
    rising: bool
    delay_us: float
    """Time between the readouts of two neighbouring rows or columns."""


class LostRows(NamedTuple):
    """Rows without events in busy moments in which the rows around them had many."""

    rows: Int64[np.ndarray, " n"]
    cases: int
    """Number of lost readouts: pairs of an interval of the recording and a row."""


class Gap(NamedTuple):
    """A time without events."""

    start_us: int
    duration_us: int
    unusual: bool
    """Whether it is far longer than the other silences."""


class Readout(NamedTuple):
    """Signs of the camera's readout in a recording."""

    clock_step_us: int
    """Greatest common divisor of the differences of times; 0 if there is only one time."""
    limits_judged: bool
    """Whether there are enough events, and fine enough times, to see a limit."""
    limit: Limit | None
    sweep: Sweep | None
    lost_rows: LostRows | None
    empty_rows: Int64[np.ndarray, " n"]
    """Rows without any event."""
    gap: Gap | None
    """The longest time without events; None if all events have the same time."""


class ReadoutSigns:
    """Collects the signs from a recording's events in constant memory; one call of `add` gets all events of a time."""

    def __init__(self, height: int, width: int):
        self._height, self._width = height, width
        self._events = self._rows = 0
        self._marks: list[Int64[np.ndarray, "n 3"]] = []
        self._mark_events = MARK_EVENTS
        self._last_us: int | None = None
        self._last_place = np.zeros(2, np.int64)
        self._last_single = np.zeros(2, bool)
        self._step_us = 0
        self._silences = np.zeros(64, np.int64)
        self._longest: list[tuple[int, int]] = []
        self._sweeps = np.zeros((2, 2, 3))
        self._intervals: list[tuple[int, Int64[np.ndarray, " h"]]] = []
        self._interval_readouts = ROW_READOUTS * height
        self._interval_rows = np.zeros(height, np.int64)
        self._interval_start_us = 0

    def add(self, events: Events) -> None:
        """Add the next events, in time order."""
        t, y, x = (column.numpy().astype(np.int64) for column in (events.t, events.y, events.x))
        first = np.flatnonzero(np.r_[True, t[1:] != t[:-1]])
        new_row = np.r_[True, (t[1:] != t[:-1]) | (y[1:] != y[:-1])]
        times_us = t[first]
        self._add_marks(new_row, first, times_us)
        self._add_silences(times_us)
        self._add_sweeps(times_us, first, y, x)
        self._add_intervals(t[new_row], y[new_row])
        self._last_us = int(times_us[-1])

    def _add_marks(self, new_row: np.ndarray, first: np.ndarray, times_us: np.ndarray) -> None:
        """Add a mark (time, events and rows so far) at each time when another `_mark_events` events are complete."""
        rows = self._rows + np.add.reduceat(new_row, first, dtype=np.int64).cumsum()
        events = self._events + np.r_[first[1:], len(new_row)]
        before = np.r_[self._events, events[:-1]]
        here = events // self._mark_events > before // self._mark_events
        self._marks.append(np.stack([times_us, events, rows], axis=1)[here])
        self._events, self._rows = int(events[-1]), int(rows[-1])
        while sum(map(len, self._marks)) > MAX_MARKS:
            self._mark_events *= 2
            self._marks = [_thinned(np.concatenate(self._marks), 1, self._mark_events)]

    def _add_silences(self, times_us: np.ndarray) -> None:
        before = times_us[:1] if self._last_us is None else np.array([self._last_us])
        silences = np.diff(np.r_[before, times_us])
        silences, starts = silences[silences > 0], np.r_[before, times_us[:-1]][silences > 0]
        if len(silences):
            self._step_us = int(np.gcd(self._step_us, np.gcd.reduce(silences)))
            self._silences += np.bincount(np.log2(silences).astype(int), minlength=64)
            longest = np.argsort(-silences, kind="stable")[:LONGEST_GAPS]
            candidates = self._longest + [(int(silences[i]), int(starts[i])) for i in longest]
            self._longest = sorted(candidates, key=lambda c: (-c[0], c[1]))[:LONGEST_GAPS]

    def _add_sweeps(self, times_us: np.ndarray, first: np.ndarray, y: np.ndarray, x: np.ndarray) -> None:
        """Add up steps between consecutive times by direction, where each time has events in one row (or column)."""
        for axis, place in enumerate((y, x)):
            low, high = np.minimum.reduceat(place, first), np.maximum.reduceat(place, first)
            single = low == high
            if self._last_us is not None:
                low = np.r_[self._last_place[axis], low]
                single = np.r_[self._last_single[axis], single]
                elapsed = np.diff(np.r_[self._last_us, times_us])
            else:
                elapsed = np.diff(times_us)
            moved = np.diff(low)
            usable = single[1:] & single[:-1] & (moved != 0)
            for direction, sign in enumerate((1, -1)):
                steps = usable & (sign * moved > 0)
                self._sweeps[axis, direction] += steps.sum(), np.abs(moved[steps]).sum(), elapsed[steps].sum()
            self._last_place[axis], self._last_single[axis] = low[-1], single[-1]

    def _add_intervals(self, t: np.ndarray, y: np.ndarray) -> None:
        """Count the readouts of each row in intervals of `_interval_readouts`; `t` and `y` are of all readouts."""
        start = 0
        while start < len(t):
            room = self._interval_readouts - int(self._interval_rows.sum())
            stop = min(len(t), start + room)
            if room == self._interval_readouts:
                self._interval_start_us = int(t[start])
            self._interval_rows += np.bincount(y[start:stop], minlength=self._height)
            start = stop
            if self._interval_rows.sum() == self._interval_readouts:
                self._intervals.append((int(t[stop - 1]) - self._interval_start_us, self._interval_rows.copy()))
                self._interval_rows[:] = 0
        if len(self._intervals) * self._height > MAX_MARKS:
            pairs = zip(self._intervals[::2], self._intervals[1::2], strict=False)
            self._intervals = [(a + b, rows + others) for (a, rows), (b, others) in pairs]
            self._interval_readouts *= 2

    def result(self, counts: Int64[np.ndarray, "h w"]) -> Readout:
        """The signs in all events, whose number at each pixel is `counts`."""
        marks = np.concatenate(self._marks) if self._marks else np.zeros((0, 3), np.int64)
        plateaus = [self._plateau(marks, column, counts) for column in (1, 2)]
        limits = [plateau for plateau in plateaus if isinstance(plateau, Limit)]
        rows = counts.sum(axis=1)
        return Readout(
            clock_step_us=self._step_us,
            limits_judged=any(plateau is not None for plateau in plateaus),
            limit=limits[0] if limits else None,
            sweep=self._sweep(),
            lost_rows=lost_rows(self._intervals),
            empty_rows=np.flatnonzero(rows == 0) if rows.any() else np.zeros(0, np.int64),
            gap=self._gap(),
        )

    def _plateau(self, marks: np.ndarray, column: int, counts: np.ndarray) -> "Limit | bool | None":
        """Limit of the rate of events (column 1) or rows (2); False if there is none, None where none could be seen."""
        if len(marks) == 0 or not self._step_us:
            return None
        active_pixels = counts.sum() ** 2 / (counts.astype(np.float64) ** 2).sum()
        per_event = marks[-1, column] / marks[-1, 1]
        size = self._mark_events
        while True:
            if size / per_event > active_pixels / PARTS_PER_PIXEL:
                return None
            blocks = _blocks(_thinned(marks, column, size), column)
            if blocks is None:
                return None
            number, duration_us, dispersion = blocks
            with np.errstate(divide="ignore"):
                rates = number / duration_us
            visible = number * self._step_us**2 * PARTS**2 < MAX_ROUNDING * 6 * PARTS * duration_us**2
            if visible[np.argsort(rates)[-MIN_BLOCKS:]].all():
                break
            size *= 2
        top = np.sort(rates)[-MIN_BLOCKS:].max()
        plateau = rates >= PLATEAU * top
        even = float(np.median(dispersion[plateau]))
        if plateau.sum() < MIN_BLOCKS or even > MAX_DISPERSION:
            return False
        rate_hz = 1e6 * number[plateau].sum() / duration_us[plateau].sum()
        share = duration_us[plateau].sum() / (marks[-1, 0] - marks[0, 0])
        return Limit("events" if column == 1 else "rows", float(rate_hz), float(share), even)

    def _sweep(self) -> Sweep | None:
        for axis, name in enumerate(("rows", "columns")):
            steps = self._sweeps[axis, :, 0]
            way = int(np.argmax(steps))
            _, moved, elapsed_us = self._sweeps[axis, way]
            if steps.sum() < MIN_SWEEP_STEPS or steps[way] < SWEEP_SHARE * steps.sum():
                continue
            if moved >= MIN_SWEEP_ROWS_PER_US * elapsed_us:
                return Sweep(name, way == 0, elapsed_us / moved)
        return None

    def _gap(self) -> Gap | None:
        if not self._longest:
            return None
        longest_us, start_us = self._longest[0]
        usual = np.searchsorted(self._silences.cumsum(), SILENCES_BELOW * self._silences.sum())
        others_us = self._longest[-1][0] if len(self._longest) == LONGEST_GAPS else longest_us
        unusual = longest_us > GAP_FACTOR * 2.0 ** (usual + 1) and longest_us > GAP_TO_OTHERS * others_us
        return Gap(start_us, longest_us, bool(unusual))


def _thinned(marks: Int64[np.ndarray, "n 3"], column: int, size: int) -> Int64[np.ndarray, "m 3"]:
    """The first mark within every `size` events (column 1) or rows (2)."""
    return marks[np.flatnonzero(np.diff(marks[:, column] // size, prepend=-1))]


def _blocks(
    marks: Int64[np.ndarray, "n 3"], column: int
) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]] | None:
    """Number, duration (us) and dispersion of each block of `PARTS` parts; None for fewer than `MIN_BLOCKS` blocks.

    The dispersion is the variance of the parts' durations that their numbers do not explain, relative to a random
    stream: 1 for random events, 0 for even spacing. Differences of neighbouring parts keep out a drift of the rate.
    """
    count = (len(marks) - 1) // PARTS
    if count < MIN_BLOCKS:
        return None
    steps = np.diff(marks[: count * PARTS + 1], axis=0).reshape(count, PARTS, 3).astype(np.float64)
    durations, numbers = steps[..., 0], steps[..., column]
    duration, number = durations.sum(axis=1), numbers.sum(axis=1)
    residuals = durations - numbers * (duration / number)[:, None]
    variance = (np.diff(residuals, axis=1) ** 2).mean(axis=1) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return number, duration, number * PARTS * variance / duration**2


def lost_rows(intervals: Sequence[tuple[int, Int64[np.ndarray, " h"]]]) -> LostRows | None:
    """Rows without events in an interval in which the nearest rows with events, above and below, had many.

    `intervals` are durations and readouts of each row. A row that has fewer than its neighbours in other intervals is
    expected to have fewer. None unless there are several cases, and far fewer at rates below the mean than above it:
    stripes of a scene leave rows empty at any rate.
    """
    if not intervals:
        return None
    durations_us = np.array([duration for duration, _ in intervals])
    busy = durations_us < durations_us.mean()
    lost = _lost(np.stack([rows for _, rows in intervals]))
    cases, quiet_cases = int(lost[busy].sum()), int(lost[~busy].sum())
    usual = cases / max(1, busy.sum()) * (~busy).sum()  # cases in quiet moments if they were as frequent
    if min(cases, usual) < MIN_LOST or usual < BUSY_TO_QUIET * quiet_cases:
        return None
    return LostRows(np.flatnonzero(lost[busy].any(axis=0)), cases)


def _lost(counts: Int64[np.ndarray, "n h"]) -> Bool[np.ndarray, "n h"]:
    height = counts.shape[1]
    expected = np.full((2, *counts.shape), 0.0)
    for side, sign in enumerate((-1, 1)):
        for distance in range(REACH, 0, -1):  # the nearest row with events comes last, and stays
            rows = np.arange(height)[distance:] if sign < 0 else np.arange(height)[:-distance]
            neighbour = counts[:, rows + sign * distance]
            both = (counts[:, rows] > 0) & (neighbour > 0)
            usual = (counts[:, rows] * both).sum(axis=0) / np.maximum((neighbour * both).sum(axis=0), 1)
            expected[side][:, rows] = np.where(neighbour > 0, neighbour * np.minimum(usual, 1), expected[side][:, rows])
    return (counts == 0) & (expected.min(axis=0) >= MIN_EXPECTED)


def readout_findings(readout: Readout, height: int) -> Iterator[str]:
    """The signs as lines of text."""
    if readout.limit:
        rate = f"{readout.limit.rate_hz:,.0f} {readout.limit.unit} a second"
        share = f"{100 * readout.limit.time_share:.0f} %"
        yield f"readout     at its limit for {share} of the time: {rate}, evenly spaced; events wait or are lost"
    elif readout.limits_judged:
        yield "readout     no limit seen"
    else:
        yield "readout     a limit cannot be seen: too few events or active pixels, or too coarse a clock"
    if readout.sweep:
        axis, rising, delay_us = readout.sweep
        way = "first to last" if rising else "last to first"
        yield f"late        {axis} are read one after another, {way}: each {delay_us:.2f} us later"
    if readout.lost_rows:
        rows, cases = readout.lost_rows
        yield f"lost rows   {_ranges(rows)}: {cases} times empty in busy moments, with many events on both sides"
    if len(readout.empty_rows):
        yield f"empty rows  {len(readout.empty_rows)} of {height} without any event: {_ranges(readout.empty_rows)}"
    if readout.gap:
        start_us, duration_us, unusual = readout.gap
        words = f"{duration_us:,} us without events from {start_us:,} us"
        yield f"gap         {words}, far longer than the others" if unusual else f"gap         at most {words}"


def _ranges(rows: Int64[np.ndarray, " n"]) -> str:
    """`3-5, 9` from sorted numbers; at most four ranges."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    words = [f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs[:4]]
    return ", ".join(words + ["..."] * (len(runs) > 4))
