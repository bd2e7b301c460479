"""Windows of events: those between the frames of a sequence, and those cut from a stream as it arrives."""

import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64, Integer
from torch import Tensor

from polarnet.events.representations import Encode
from polarnet.events.stream import Events, concatenate, slice_count, slice_time
from polarnet.runtime.arrays import Array, whole_numbers

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
    joined: int = 1
    """Number of windows that `join_windows` put together, because a processor did not keep up with a camera."""

    @property
    def length_us(self) -> int:
        """Length of the window, at least 1."""
        return max(1, self.stop_us - self.start_us)


def join_windows(windows: Sequence[EventWindow]) -> EventWindow:
    """One window with the events of windows that end one after the other, each event once even if they overlap."""
    parts = [windows[0].channels]
    for before, after in itertools.pairwise(windows):
        parts.append([slice_time(events, before.stop_us, after.stop_us) for events in after.channels])
    channels = [concatenate(of_one) for of_one in zip(*parts, strict=True)]
    return EventWindow(channels, windows[0].start_us, windows[-1].stop_us, sum(window.joined for window in windows))


@dataclass(frozen=True)
class WindowRule:
    """Length of the windows, and the step between their ends."""

    length_us: int
    step_us: int | None
    """None: each window begins at the end of the previous window."""

    def __post_init__(self):
        if self.length_us < SHORTEST_STEP_US:
            raise ValueError(f"expected windows of at least {SHORTEST_STEP_US} us, got {self.length_us}")
        if self.step_us is not None:
            if self.step_us < SHORTEST_STEP_US:
                raise ValueError(f"expected a step of at least {SHORTEST_STEP_US / 1000} ms, got {self.step_us} us")
            if self.step_us > self.length_us:
                expected = f"a step no longer than the windows of {self.length_us} us"
                raise ValueError(f"expected {expected}, got {self.step_us} us: events between windows would be lost")


class WindowCutter:
    """Cuts a stream that arrives in pieces into windows, each as soon as all of its events are known.

    The first window ends after one whole length, the others every step (or length). Times count from 0.
    """

    def __init__(self, rule: WindowRule, height: int, width: int, channels: int = 4):
        self.rule = rule
        self._held = [Events.empty(height, width)] * channels
        self._next_us = rule.length_us
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
        return self._complete(until_us)

    def _check_pauses(self, channels: Sequence[Events], until_us: int) -> None:
        start_us, self._until_us = self._until_us, until_us
        if until_us - start_us <= MAX_PAUSE_US:
            return
        times = torch.cat([torch.tensor([start_us, until_us]), *(one.t for one in channels)]).sort().values
        pauses = times.diff()
        if int(pauses.max()) > MAX_PAUSE_US:
            start_us, stop_us = times[pauses.argmax() :][:2].tolist()
            raise ValueError(
                f"expected events without a pause longer than {MAX_PAUSE_US // 1_000_000} s, got none between "
                f"{start_us} and {stop_us} us: a damaged time stamp? cut the recording there"
            )

    def _complete(self, until_us: int) -> Iterator[EventWindow]:
        while self._next_us <= until_us:
            start_us = self._next_us - self.rule.length_us
            self._held = [slice_time(held, start_us, sys.maxsize) for held in self._held]
            channels = [slice_time(held, start_us, self._next_us) for held in self._held]
            yield EventWindow(channels, start_us, self._next_us)
            self._next_us += self.rule.step_us or self.rule.length_us


def windows_of(t_us: Int64[Tensor, " n"]) -> list[tuple[int, int]]:
    """(start, stop) of the windows between consecutive frame times: one fewer than there are frames."""
    return list(itertools.pairwise(t_us.tolist()))


def cut_windows(events: Events, t_us: Int64[Tensor, " n"]) -> list[Events]:
    """The events of each window of `windows_of`, half-open: start <= t < stop."""
    return [slice_count(events, start, stop) for start, stop in windows_of(torch.searchsorted(events.t, t_us))]


def encode_windows(channels: Sequence[Events], t_us: Integer[Array, " n"], encode: Encode) -> Float[Tensor, "t c h w"]:
    """Encode every window between consecutive times `t_us`; the second axis holds the channels one after the other.

    ValueError for fewer than two frame times, which leave no window, and for times that do not increase.
    """
    t_us = whole_numbers("t_us", t_us)
    if t_us.ndim != 1 or len(t_us) < 2 or (t_us.diff() <= 0).any():
        raise ValueError(f"expected at least two frame times, each later than the last, got {t_us.tolist()}")
    lengths = t_us.diff().tolist()
    per_channel = [torch.stack(list(map(encode, cut_windows(events, t_us), lengths))) for events in channels]
    height, width = per_channel[0].shape[-2:]
    return torch.cat([images.view(len(lengths), -1, height, width) for images in per_channel], dim=1)
