"""Read events as a camera delivers them: lines of text from standard input or from a file that grows.

The first line is `width height` of the sensor. Each other line is an event: `t x y p angle`, separated by blanks or
commas; t in whole microseconds, p 1 or 0 (or -1), angle the polarizer's, 0, 45, 90 or 135. A camera with a mosaic of
polarizers gives `t x y p`. # starts a comment.
"""

import itertools
import os
import stat
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from queue import Queue
from threading import Thread
from typing import BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Bool, Int64

from polarnet.events.mosaic import split_mosaic
from polarnet.events.stream import MAX_SIDE, Events
from polarnet.recordings.formats.lines import lines_of, numbers_of, rows_of
from polarnet.recordings.repair import TOLERATED_COUNT, TOLERATED_SHARE
from polarnet.recordings.source import RecordingError
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic

READ_BYTES = 2**20
MAX_READ_AHEAD = 64  # blocks of READ_BYTES, for a file; a camera does not wait, so its queue is unbounded
POLL_S = 0.001
DAMAGE = {
    "unreadable_lines": "lines that are not {columns}",
    "bad_polarity": "events of a polarity that is not 1, 0 or -1",
    "bad_angle": "events of an angle that is not 0, 45, 90 or 135",
    "out_of_range": "events that are not on the sensor",
    "late": "events earlier than others that were used already",
}


class Piece(NamedTuple):
    """The events that arrived since the previous piece."""

    channels: Sequence[Events]
    """Four channels; times count from the first event of the stream."""
    until_us: int
    """Every later piece holds only events at or after this time."""
    read_at: float
    """When its first data arrived, by `time.perf_counter`."""


class StreamClock:
    """Time of a stream, which counts from its first event; events older than those of an earlier piece are late."""

    def __init__(self) -> None:
        self.until_us = 0
        self._origin_us: int | None = None

    def on_time(self, t: Int64[np.ndarray, " n"]) -> tuple[Int64[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Times of the next n >= 1 events by this clock, and which events are not late; moves `until_us` on."""
        self._origin_us = int(t[0]) if self._origin_us is None else self._origin_us
        times_us = t - self._origin_us
        current = times_us >= self.until_us
        self.until_us = max(self.until_us, int(times_us.max()))
        return times_us, current


class LiveLines:
    """Read lines as they arrive, in pieces; ends with the input, or once a file has not grown for `idle_s`.

    Unusable lines, and late ones, which are older than an event of an earlier piece, are left out and counted in
    `counts`. RecordingError where more than 1 % of the lines (and 8) are unusable for the same reason, or where the
    first line is not a size. The source is closed at its end, unless it is standard input.
    """

    def __init__(self, source: BinaryIO, name: str, mosaic: Mosaic | None, idle_s: float):
        self.name, self.mosaic = name, mosaic
        self.counts: Counter[str] = Counter()
        self._source, self._idle_s = source, idle_s
        self._grows = stat.S_ISREG(os.fstat(source.fileno()).st_mode)
        self._queue: Queue[tuple[bytes, float] | None] = Queue(MAX_READ_AHEAD if self._grows else 0)
        own = os.dup(source.fileno())  # a duplicate, so that a file opened later cannot get its number
        Thread(target=self._read, args=[own], daemon=True).start()
        self._blocks = self._whole_lines()
        self._sensor = self._first_line()
        self.height, self.width = (side // 2 if mosaic else side for side in self._sensor)

    def __iter__(self) -> Iterator[Piece]:
        columns = "t x y p" if self.mosaic else "t x y p angle"
        shift = np.zeros(len(columns.split()), np.int64)
        clock, lines = StreamClock(), 0
        for data, read_at in self._blocks:
            rows = [*rows_of(data, shift, self.counts, "unreadable_lines")]
            table = self._usable(np.concatenate(rows)) if rows else np.empty((0, len(shift)), np.int64)
            lines += data.count(b"\n")
            self._refuse_damage(columns, lines)
            if len(table) == 0:
                continue
            table = table[np.argsort(table[:, 0], kind="stable")]
            table[:, 0], current = clock.on_time(table[:, 0])
            self.counts["late"] += int(np.count_nonzero(~current))
            if current.any():
                yield Piece(self._channels(table[current]), clock.until_us, read_at)

    def _first_line(self) -> tuple[int, int]:
        """Height and width; the rest of what has arrived stays in `_blocks`."""
        data, read_at = next(self._blocks, (b"", 0.0))
        line, _, rest = data.partition(b"\n")
        words = [word for one in numbers_of(line) for word in one.words]
        if len(words) != 2 or not all(w.isdigit() and 0 < int(w) <= MAX_SIDE for w in words):
            raise RecordingError(f"{self.name}: expected a first line `width height` of the sensor, such as `346 260`")
        if rest:
            self._blocks = itertools.chain([(rest, read_at)], self._blocks)
        return int(words[1]), int(words[0])

    def _whole_lines(self) -> Iterator[tuple[bytes, float]]:
        """Complete lines with their time of arrival; at the end of the input, also an incomplete last line."""
        rest, read_at = b"", 0.0
        while (arrived := self._queue.get()) is not None:
            data, read_at = arrived
            while len(data) < READ_BYTES and not self._queue.empty():  # data already waiting joins this piece
                if (more := self._queue.get()) is None:
                    self._queue.put(None)
                    break
                data += more[0]
            lines, end, rest = (rest + data).rpartition(b"\n")
            if end:
                yield lines + end, read_at
        if rest.strip():
            yield rest + b"\n", read_at

    def _read(self, descriptor: int) -> None:
        """Queue incoming data with its time of arrival, in a separate thread, since recovery may be busy meanwhile."""
        quiet_since = time.monotonic()
        try:
            while not self._source.closed:
                data = os.read(descriptor, READ_BYTES)  # returns the data available, without waiting for more
                if data:
                    self._queue.put((data, time.perf_counter()))
                    quiet_since = time.monotonic()
                elif not self._grows or time.monotonic() - quiet_since > self._idle_s:
                    return
                else:
                    time.sleep(POLL_S)
        except OSError:  # the other end was closed
            return
        finally:
            os.close(descriptor)
            if self._source is not sys.stdin.buffer:
                self._source.close()
            self._queue.put(None)

    def _usable(self, table: Int64[np.ndarray, "n columns"]) -> Int64[np.ndarray, "m columns"]:
        height, width = self._sensor
        checks = {
            "out_of_range": (table[:, 1] >= 0) & (table[:, 1] < width) & (table[:, 2] >= 0) & (table[:, 2] < height),
            "bad_polarity": np.abs(table[:, 3]) <= 1,
            "bad_angle": np.isin(table[:, 4], POLARIZER_ANGLES_DEG) if not self.mosaic else np.ones(len(table), bool),
        }
        usable = np.ones(len(table), bool)
        for kind, good in checks.items():
            self.counts[kind] += int(np.count_nonzero(~good))
            usable &= good
        return table[usable]

    def _refuse_damage(self, columns: str, lines: int) -> None:
        for kind, words in DAMAGE.items():
            if kind != "late" and self.counts[kind] > max(TOLERATED_COUNT, TOLERATED_SHARE * lines):
                raise RecordingError(
                    f"{self.name}: {self.counts[kind]} of the first {lines} lines are "
                    f"{words.format(columns=f'`{columns}`')}; is the format right, and the size in the first line?"
                )

    def _channels(self, table: Int64[np.ndarray, "n columns"]) -> list[Events]:
        if self.mosaic:
            return split_mosaic(_events(table, *self._sensor), self.mosaic)
        return [_events(table[table[:, 4] == angle], *self._sensor) for angle in POLARIZER_ANGLES_DEG]


def live_lines(channels: Sequence[Events]) -> tuple[bytes, Int64[np.ndarray, " n"], bytes]:
    """Four channels in the format of `LiveLines`: the first line, the sorted times, and the lines in that order."""
    tables = [
        np.stack([*(getattr(events, name).numpy().astype(np.int64) for name in "txyp"), np.full(len(events), angle)], 1)
        for events, angle in zip(channels, POLARIZER_ANGLES_DEG, strict=True)
    ]
    table = np.concatenate(tables)
    table = table[np.argsort(table[:, 0], kind="stable")]
    head = f"{channels[0].width} {channels[0].height}\n".encode()
    return head, table[:, 0], lines_of(table, " ")


def _events(table: Int64[np.ndarray, "n columns"], height: int, width: int) -> Events:
    t, x, y, p = table[:, :4].T
    return Events.from_columns(t, x, y, np.where(p > 0, 1, -1), height, width)
