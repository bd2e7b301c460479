"""Cut a stream of events into windows as it arrives: by time or by number of events, consecutive or overlapping.

`WindowCutter` accepts events all at once or in pieces.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from polarnet.events.stream import Events, concatenate, slice_count

SHORTEST_STEP_US = 100
MAX_PAUSE_US = 3_600_000_000
"""Longest accepted time without an event; a longer one comes from a damaged time stamp and gives endless windows."""
TRAINED_WINDOW_US = 33_333
"""Window length in the training of the networks, 1/30 s."""


class EventWindow(NamedTuple):
    """Events with start_us <= t < stop_us of the four channels (0, 45, 90, 135 degrees), or of one channel.

    >>> from polarnet.events import Events, EventWindow
    >>> EventWindow([Events.empty(120, 180)] * 4, start_us=0, stop_us=33_333).length_us
    33333
    """

    channels: Sequence[Events]
    start_us: int
    stop_us: int

    @property
    def length_us(self) -> int:
        """Length of the window, at least 1."""
        return max(1, self.stop_us - self.start_us)


@dataclass(frozen=True)
class WindowRule:
    """Length of the windows, and the step between their ends. Exactly one of `length_us` and `events` is given."""

    length_us: int | None
    events: int | None
    """Number of events in the four channels together."""
    step_us: int | None
    """Time from one window's end to the next; None: each window begins at the end of the previous window."""

    def __post_init__(self):
        if (self.length_us is None) == (self.events is None):
            raise ValueError(f"expected windows of a time or of a number of events, got {self}")
        if self.length_us is not None and self.length_us < SHORTEST_STEP_US:
            raise ValueError(f"expected windows of at least {SHORTEST_STEP_US} us, got {self.length_us}")
        if self.events is not None and self.events < 2:
            raise ValueError(f"expected windows of at least 2 events, got {self.events}")
        if self.step_us is not None:
            if self.step_us < SHORTEST_STEP_US:
                raise ValueError(f"expected a step of at least {SHORTEST_STEP_US / 1000} ms, got {self.step_us} us")
            if self.length_us is not None and self.step_us > self.length_us:
                raise ValueError(
                    f"expected a step no longer than the windows of {self.length_us} us, got {self.step_us} us: "
                    f"events between windows would be lost"
                )


def parse_window(text: str) -> tuple[int | None, int | None]:
    """Parse "33.3ms" to (microseconds, None), or "20000ev" to (None, number); ValueError for anything else."""
    match = re.fullmatch(r"(?P<number>\d+(\.\d*)?|\.\d+)\s*(?P<unit>us|ms|s|ev|events)", text.strip())
    if match is None or (match["unit"] in ("ev", "events") and not match["number"].isdigit()):
        raise ValueError(f"expected a time such as 33.3ms or a number of events such as 20000ev, got {text!r}")
    if match["unit"] in ("ev", "events"):
        return None, int(match["number"])
    return round(float(match["number"]) * {"us": 1, "ms": 1_000, "s": 1_000_000}[match["unit"]]), None


class WindowCutter:
    """Cuts a stream that arrives in pieces into windows, each as soon as all of its events are known.

    Windows by time end after one whole length, and then every step (or length); each starts one length before its end.
    Windows by number end with their last event and start at the previous window's end. With a step, a window by number
    holds the last `events` events before each multiple of the step, and starts with the first of them. Events that no
    later window needs are dropped. Times count from 0.
    """

    def __init__(self, rule: WindowRule, height: int, width: int, channels: int = 4):
        self.rule = rule
        self._held = [Events.empty(height, width)] * channels
        self._next_us = rule.length_us if rule.length_us is not None else rule.step_us
        self._start_us = 0
        self._until_us = 0

    def add(self, channels: Sequence[Events], until_us: int) -> Iterator[EventWindow]:
        """Add new events; yields the windows that are complete once every event before `until_us` has arrived.

        ValueError unless there are as many channels as before, of the same size, with no event earlier than those
        already added, or after more than `MAX_PAUSE_US` without events.
        """
        if len(channels) != len(self._held):
            raise ValueError(f"expected the events of {len(self._held)} channels, got {len(channels)} channels")
        self._check_pauses(channels, until_us)
        self._held = [concatenate([held, new]) for held, new in zip(self._held, channels, strict=True)]
        if self.rule.length_us is not None:
            return self._by_time(self.rule.length_us, until_us)
        assert self.rule.events is not None
        if self.rule.step_us is not None:
            return self._last_events(self.rule.events, self.rule.step_us, until_us)
        return self._by_number(self.rule.events, until_us)

    def _check_pauses(self, channels: Sequence[Events], until_us: int) -> None:
        start_us, self._until_us = self._until_us, until_us
        if until_us - start_us <= MAX_PAUSE_US:
            return
        times = torch.cat([torch.tensor([start_us, until_us]), *(one.t for one in channels)]).sort().values
        pauses = times.diff()
        if int(pauses.max()) > MAX_PAUSE_US:
            before = int(pauses.argmax())
            raise ValueError(
                f"expected events without a pause longer than {MAX_PAUSE_US // 1_000_000} s, got none between "
                f"{int(times[before])} and {int(times[before + 1])} us: a damaged time stamp? cut the recording there"
            )

    def _by_time(self, length_us: int, until_us: int) -> Iterator[EventWindow]:
        assert self._next_us is not None
        while self._next_us <= until_us:
            start_us = self._next_us - length_us
            self._forget(self._places(start_us))
            yield self._window(start_us, self._next_us, self._places(self._next_us))
            self._next_us += self.rule.step_us or length_us

    def _by_number(self, count: int, until_us: int) -> Iterator[EventWindow]:
        known = self._places(until_us)
        times = torch.cat([held.t[:n] for held, n in zip(self._held, known, strict=True)]).sort().values
        used = 0
        while used + count <= len(times):
            stop_us = int(times[used + count - 1]) + 1  # all events at this time belong to the window
            stops = self._places(stop_us)
            window = self._window(self._start_us, stop_us, stops)
            used += sum(stops)
            self._forget(stops)
            self._start_us = stop_us
            yield window

    def _last_events(self, count: int, step_us: int, until_us: int) -> Iterator[EventWindow]:
        assert self._next_us is not None
        while self._next_us <= until_us:
            stops = self._places(self._next_us)
            times = torch.cat([held.t[:n] for held, n in zip(self._held, stops, strict=True)])
            surplus = len(times) - count
            if surplus >= 0:
                start_us = int(times.kthvalue(surplus + 1).values)
                self._forget(self._places(start_us))
                yield self._window(start_us, self._next_us, self._places(self._next_us))
            self._next_us += step_us

    def _places(self, t_us: int) -> list[int]:
        return [int(torch.searchsorted(held.t, t_us)) for held in self._held]

    def _window(self, start_us: int, stop_us: int, stops: Sequence[int]) -> EventWindow:
        channels = [slice_count(held, 0, stop) for held, stop in zip(self._held, stops, strict=True)]
        return EventWindow(channels, start_us, stop_us)

    def _forget(self, places: Sequence[int]) -> None:
        self._held = [slice_count(held, place, len(held)) for held, place in zip(self._held, places, strict=True)]
