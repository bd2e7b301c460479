"""Signs in a recording that a camera's readout lost events: rows without any event, and gaps in time."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

LONGEST_GAPS = 20
GAP_FACTOR = 10  # a gap is longer than all but one silence in a thousand by this factor
GAP_TO_OTHERS = 3  # and than the twentieth longest silence by this one
SILENCES_BELOW = 0.999
MAX_RANGES = 4  # of empty rows in words


class Gap(NamedTuple):
    """A time without events."""

    start_us: int
    duration_us: int
    unusual: bool
    """Whether it is far longer than the other silences."""


class Silences:
    """Collects the times between consecutive events of a recording in constant memory."""

    def __init__(self) -> None:
        self.clock_step_us = 0
        """Greatest common divisor of the differences of times; 0 if there is only one time."""
        self._last_us: int | None = None
        self._counts = np.zeros(64, np.int64)  # by the integer part of the binary logarithm
        self._longest: list[tuple[int, int]] = []  # duration and start

    def add(self, t: Int64[np.ndarray, " n"]) -> None:
        """Add the times of the next events, in order; n is at least 1."""
        times_us = t if self._last_us is None else np.r_[self._last_us, t]
        self._last_us = int(t[-1])
        silences = np.diff(times_us)
        starts, silences = times_us[:-1][silences > 0], silences[silences > 0]
        if not len(silences):
            return
        self.clock_step_us = int(np.gcd(self.clock_step_us, np.gcd.reduce(silences)))
        self._counts += np.bincount(np.log2(silences).astype(int), minlength=64)
        longest = np.argsort(-silences, kind="stable")[:LONGEST_GAPS]
        candidates = self._longest + [(int(silences[i]), int(starts[i])) for i in longest]
        self._longest = sorted(candidates, key=lambda silence: (-silence[0], silence[1]))[:LONGEST_GAPS]

    def gap(self) -> Gap | None:
        """The longest time without events; None if all events have the same time."""
        if not self._longest:
            return None
        longest_us, start_us = self._longest[0]
        usual = np.searchsorted(self._counts.cumsum(), SILENCES_BELOW * self._counts.sum())
        others_us = self._longest[-1][0] if len(self._longest) == LONGEST_GAPS else longest_us
        unusual = longest_us > GAP_FACTOR * 2.0 ** (usual + 1) and longest_us > GAP_TO_OTHERS * others_us
        return Gap(start_us, longest_us, bool(unusual))


def readout_findings(gap: Gap | None, counts: Int64[np.ndarray, "h w"]) -> Iterator[str]:
    """The signs as lines of text; `counts` are the events of each pixel."""
    empty = np.flatnonzero(counts.sum(axis=1) == 0)
    if 0 < len(empty) < len(counts):
        yield f"empty rows  {len(empty)} of {len(counts)} without any event: {_ranges(empty)}"
    if gap:
        words = f"{gap.duration_us:,} us without events from {gap.start_us:,} us"
        yield f"gap         {words}, far longer than the others" if gap.unusual else f"gap         at most {words}"


def _ranges(rows: Int64[np.ndarray, " n"]) -> str:
    """`3-5, 9` from sorted numbers; at most four ranges."""
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    words = [f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs[:MAX_RANGES]]
    return ", ".join(words + ["..."] * (len(runs) > MAX_RANGES))
