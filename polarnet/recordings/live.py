"""Read events as a camera delivers them: lines of text from standard input or a file, or a camera itself.

The first line is `width height` of the sensor. Each other line is an event: `t x y p angle`, separated by blanks or
commas; t in whole microseconds, p 1 or 0 (or -1), angle the polarizer's, 0, 45, 90 or 135. A camera with a mosaic of
polarizers gives `t x y p`. # starts a comment.

Cameras are read through the package dv-processing. dv://HOST:PORT is a running acquisition program that streams events
over the network (DV, dv-runtime, or another program with a NetworkWriter); dv://camera is the first camera of iniVation
that is plugged in.
"""

import itertools
import os
import re
import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, BinaryIO, TypeAlias, TypeVar

import numpy as np
import torch
from jaxtyping import Int64

from polarnet.events.stream import MAX_SIDE, Events, split_mosaic
from polarnet.recordings.ahead import Ahead
from polarnet.recordings.arrangements import Input, pieces_of
from polarnet.recordings.formats.lines import lines_of, numbers_of, rows_of
from polarnet.recordings.repair import Clock, refuse_much_damage, usable
from polarnet.recordings.source import SAFE, Block, Counts, RecordingError
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic
from polarnet.terminal.installation import installation

READ_BYTES = 2**20  # of one piece at most
PIPE_BYTES = 2**16  # capacity of a pipe, which bounds what one read returns
MAX_READ_AHEAD = 2**26  # bytes that wait to be parsed; if there are more, the program at the other end has to wait
MAX_BATCHES = 512  # of a camera, that wait to be read
POLL_S = 0.001
MAX_WAIT_S = 0.02  # events whose times later ones must confirm wait no longer, unless later ones have arrived
SCHEME, CAMERA = "dv://", "camera"
NETWORK = re.compile(r"(?P<host>[^:/]+):(?P<port>\d{1,5})")

Table: TypeAlias = Int64[np.ndarray, "n columns"]
Tables: TypeAlias = Iterable[tuple[Table | None, float]]
Lines: TypeAlias = Iterator[tuple[bytes | None, float]]
Patience: TypeAlias = Callable[[], float | None]
Data = TypeVar("Data")


class _Stream:
    """Makes blocks of four channels from the events of a mosaic, or of four sensors, as they arrive."""

    def __init__(self, name: str, height: int, width: int, mosaic: Mosaic | None):
        self.name, self.counts = name, Counts()
        self._sensor, self._mosaic = (height, width), mosaic
        self._clock = Clock(name, self.counts, live=True)
        self._since = 0.0

    def patience_s(self) -> float | None:
        """Seconds until the events that are held back are to be flushed; None if there are none."""
        return max(0.0, self._since + MAX_WAIT_S - time.perf_counter()) if self._clock.waiting else None

    def input(self, tables: Tables, unread: Callable[[], bool], *, waits: bool) -> Input:
        """Tables and their times of arrival as an input; None where events were held back for long enough."""
        _warm_up(self._mosaic)
        height, width = (side // 2 if self._mosaic else side for side in self._sensor)
        blocks = itertools.chain.from_iterable(self._add(*one) for one in itertools.chain(tables, [(None, 0.0)]))
        repairs = [(self.name, self.counts)]
        return Input(self.name, height, width, pieces_of(blocks), repairs, live=True, waits=waits, unread=unread)

    def table(self, lines: bytes) -> Table:
        """The rows of complete lines; the others are counted."""
        columns = np.zeros(5 if self._mosaic is None else 4, np.int64)
        rows = [*rows_of(lines, columns, self.counts, "unreadable_lines")] or [np.empty((0, len(columns)), np.int64)]
        return rows[0] if len(rows) == 1 else np.concatenate(rows)

    def _add(self, table: Table | None, read_at: float) -> Iterator[tuple[list[Events], float]]:
        """Channels of the next rows `t x y p` or `t x y p angle`, and the time of arrival of the first of them."""
        self._since = self._since if self._clock.waiting else read_at
        t, x, y, p, *angle = np.empty((4, 0), np.int64) if table is None else table.T
        good = usable(Block(t, x, y, np.where(p == -1, 0, p)), *self._sensor, 0, self.counts)
        p = np.where(p > 0, 1, -1)
        if angle:
            channel = np.searchsorted(POLARIZER_ANGLES_DEG[:-1], angle[0])
            known = np.array(POLARIZER_ANGLES_DEG)[channel] == angle[0]
            self.counts["bad_angle"] += int(np.count_nonzero(good & ~known))
            good &= known
            p *= 1 + channel  # the clock sorts the columns of `Block` alone, so p holds the channel too
        t = t.copy()  # a view would hold the whole table
        block = Block(t, x.astype(np.int16), y.astype(np.int16), p.astype(np.int8))
        block = block if good.all() else block.rows(good)
        for ready in self._clock.ordered(block, final=table is None):
            yield self._channels(ready), self._since

    def _channels(self, block: Block) -> list[Events]:
        if self._mosaic:
            return split_mosaic(self._events(block), self._mosaic)
        channel = np.abs(block.p)
        order, numbers = np.argsort(channel, kind="stable"), np.arange(1, len(POLARIZER_ANGLES_DEG))
        sorted_rows = block.rows(order)
        ends = [0, *np.searchsorted(channel[order], numbers, side="right"), len(channel)]
        return [self._events(sorted_rows.rows(slice(*of_channel))) for of_channel in itertools.pairwise(ends)]

    def _events(self, block: Block) -> Events:
        t, x, y, p = map(torch.from_numpy, block)
        return Events(t, x, y, p.sign(), *self._sensor)


def _warm_up(mosaic: Mosaic | None) -> None:
    """Read a line to nowhere, so that the first of a camera does not wait until kernels are loaded or compiled."""
    stream = _Stream("", 2, 2, mosaic)
    for _ in stream._add(stream.table(b"0 0 0 0" + b" 0" * (mosaic is None) + b"\n"), 0.0):
        pass


def read_lines(source: BinaryIO, name: str, mosaic: Mosaic | None) -> Input:
    """Read lines as they arrive, up to the end of the source, which is closed unless it is standard input.

    Unusable lines and events with wrong times are left out and counted. RecordingError where more than 1 % of the lines
    (and 8) are unusable for the same reason, or where the first line is not a size.
    """
    waits = stat.S_ISREG(os.fstat(source.fileno()).st_mode)
    own = os.dup(source.fileno())  # a duplicate, so that a file opened later cannot get its number
    ahead = Ahead(_read(source, own), MAX_READ_AHEAD // (READ_BYTES if waits else PIPE_BYTES))
    stream: _Stream | None = None
    (width, height), lines = _size(name, _whole_lines(ahead, lambda: stream.patience_s() if stream else None))
    stream = _Stream(name, height, width, mosaic)

    def tables() -> Tables:
        number = 0
        for data, read_at in lines:
            if data is None:
                yield None, read_at
                continue
            number += data.count(b"\n")
            yield stream.table(data), read_at
            refuse_much_damage(name, stream.counts, number, (*SAFE, "time_glitches"))

    return stream.input(tables(), ahead.ready, waits=waits)


def _size(name: str, lines: Lines) -> tuple[list[int], Lines]:
    """Width and height in the first line that is no comment, and the lines after it."""
    line = b""
    while not line.partition(b"#")[0].strip():
        data, read_at = next(lines, (None, 0.0))
        if data is None:
            break
        line, _, rest = data.partition(b"\n")
        lines = itertools.chain([(rest, read_at)] if rest else [], lines)
    words = [word for one in numbers_of(line) for word in one.words]
    if len(words) != 2 or not all(w.isdigit() and 0 < int(w) <= MAX_SIDE for w in words):
        raise RecordingError(f"{name}: expected a first line `width height` of the sensor, such as `346 260`")
    return [*map(int, words)], lines


def _arrived(ahead: Ahead[tuple[Data, float]], patience_s: Patience) -> Iterator[tuple[Data | None, float]]:
    """Data with their times of arrival, None where events were held back for long enough."""
    while True:
        try:
            yield ahead.within(patience_s()) or (None, time.perf_counter())
        except StopIteration:
            return


def _whole_lines(ahead: Ahead[tuple[bytes, float]], patience_s: Patience) -> Lines:
    """Complete lines with their time of arrival, none where none is complete yet; None as in `_arrived`.

    At the end of the input, also an incomplete last line.
    """
    rest, read_at = b"", 0.0
    for data, read_at in _arrived(ahead, patience_s):
        if data is None:
            yield None, read_at
            continue
        parts, size = [rest, data], len(data)
        while size < READ_BYTES and ahead.ready() and (more := next(ahead, None)):  # what is there joins this piece
            parts.append(more[0])
            size += len(more[0])
        lines, end, rest = b"".join(parts).rpartition(b"\n")
        yield lines + end, read_at
    if rest.strip():
        yield rest + b"\n", read_at


def _read(source: BinaryIO, descriptor: int) -> Iterator[tuple[bytes, float]]:
    """Incoming data with its time of arrival."""
    try:
        while not source.closed and (data := os.read(descriptor, READ_BYTES)):  # the data available
            yield data, time.perf_counter()
    except OSError:  # the other end was closed
        return
    finally:
        os.close(descriptor)
        if source is not sys.stdin.buffer:
            source.close()


def read_camera(address: str, mosaic: Mosaic, idle_s: float) -> Input:
    """Read a camera as its events arrive; ends with the connection, or after `idle_s` without an event.

    Events with wrong times are left out and counted. RuntimeError where dv-processing is missing; RecordingError where
    the camera or program cannot be reached.
    """
    reader = _opened(address)
    width, height = reader.getEventResolution()
    stream = _Stream(address, height, width, mosaic)
    ahead = Ahead(_batches(reader, idle_s), MAX_BATCHES)
    tables = _arrived(ahead, stream.patience_s)
    return stream.input(tables, ahead.ready, waits=False)


def _batches(reader: Any, idle_s: float) -> Iterator[tuple[Table, float]]:
    """Rows `t x y p` of a camera with their time of arrival."""
    quiet_since = time.monotonic()
    while time.monotonic() - quiet_since < idle_s:
        batch = reader.getNextEventBatch()
        if batch is not None and not batch.isEmpty():
            read_at, quiet_since = time.perf_counter(), time.monotonic()
            columns = batch.timestamps(), batch.coordinates(), batch.polarities()
            table = np.concatenate([np.array(one, np.int64).reshape(batch.size(), -1) for one in columns], axis=1)
            yield table, read_at
        elif reader.isRunning():
            time.sleep(POLL_S)
        else:
            break


def _opened(address: str) -> Any:
    """The camera, or the connection to a program."""
    try:
        import dv_processing
    except ImportError:
        raise RuntimeError(f"{address} needs dv-processing: {installation('recordings')}") from None
    place = address.removeprefix(SCHEME)
    network = NETWORK.fullmatch(place)
    if network is None and place != CAMERA:
        raise ValueError(f"expected {SCHEME}HOST:PORT or {SCHEME}{CAMERA}, got {address}")
    try:
        if network:
            reader = dv_processing.io.NetworkReader(network["host"], int(network["port"]))
        else:
            reader = dv_processing.io.camera.open()
    except RuntimeError as error:
        raise RecordingError(f"{address} cannot be reached: {error}; is it running, and does it stream?") from None
    if not reader.isEventStreamAvailable():
        raise RecordingError(f"{address}: expected a stream of events, there is none; choose another output")
    return reader


def live_lines(channels: Sequence[Events]) -> tuple[bytes, Int64[np.ndarray, " n"], bytes]:
    """Four channels in the format of `read_lines`: the first line, the sorted times, and the lines in that order."""
    tables = [
        np.stack([*(getattr(events, name).numpy().astype(np.int64) for name in "txyp"), np.full(len(events), angle)], 1)
        for events, angle in zip(channels, POLARIZER_ANGLES_DEG, strict=True)
    ]
    table = np.concatenate(tables)
    table = table[np.argsort(table[:, 0], kind="stable")]
    head = f"{channels[0].width} {channels[0].height}\n".encode()
    return head, table[:, 0], lines_of(table, " ")


def replay(channels: Sequence[Events], speed: float, write: Callable[[bytes], object]) -> None:
    """Write four channels in the format of `read_lines`, at `speed` times the original pace."""
    head, times, lines = live_lines(channels)
    write(head)
    ends = [0, *itertools.accumulate(map(len, lines.splitlines(keepends=True)))]
    started, sent = time.perf_counter(), 0
    while sent < len(times):
        due_us = int((time.perf_counter() - started) * 1e6 * speed)
        come = int(times.searchsorted(due_us, side="right"))
        if come > sent:
            asked = time.perf_counter()
            write(lines[ends[sent] : ends[come]])
            started += time.perf_counter() - asked  # time spent waiting for the reader does not count
            sent = come
        else:
            time.sleep(POLL_S)
