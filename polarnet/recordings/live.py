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
from collections.abc import Callable, Iterator, Sequence
from queue import Empty, Queue
from threading import Thread
from typing import Any, BinaryIO

import numpy as np
import torch
from jaxtyping import Int64

from polarnet.events.mosaic import split_mosaic
from polarnet.events.stream import MAX_SIDE, Events
from polarnet.recordings.arrangements import Piece, pieces_of
from polarnet.recordings.formats.lines import lines_of, numbers_of, rows_of
from polarnet.recordings.repair import Clock, refuse_much_damage, usable
from polarnet.recordings.source import SAFE, Block, Counts, RecordingError
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic
from polarnet.terminal.installation import installation

READ_BYTES = 2**18
PIPE_BYTES = 2**16  # capacity of a pipe, which bounds what one read returns
MAX_READ_AHEAD = 2**26  # bytes that wait to be parsed; if there are more, the program at the other end has to wait
POLL_S = 0.001
MAX_WAIT_S = 0.02  # events whose times later ones must confirm wait no longer, unless later ones have arrived
SCHEME, CAMERA = "dv://", "camera"
NETWORK = re.compile(r"(?P<host>[^:/]+):(?P<port>\d{1,5})")


class _Stream:
    """Makes blocks of four channels from the events of a mosaic, or of four sensors, as they arrive."""

    def __init__(self, name: str, height: int, width: int, mosaic: Mosaic | None):
        self.height, self.width = (side // 2 if mosaic else side for side in (height, width))
        self.counts = Counts()
        self._sensor, self._mosaic = (height, width), mosaic
        self._clock = Clock(name, self.counts, live=True)
        self._since = 0.0

    def patience_s(self) -> float | None:
        """Seconds until the events that are held back are to be flushed; None if there are none."""
        return max(0.0, self._since + MAX_WAIT_S - time.perf_counter()) if self._clock.waiting else None

    def add(
        self, table: Int64[np.ndarray, "n columns"], read_at: float, *, flush: bool = False
    ) -> Iterator[tuple[list[Events], float]]:
        """Channels of the next rows `t x y p` or `t x y p angle`, and the time of arrival of the first of them."""
        self._since = self._since if self._clock.waiting else read_at
        t, x, y, p, *angle = table.T
        good = usable(Block(t, x, y, np.where(p == -1, 0, p)), *self._sensor, 0, self.counts)
        p = np.where(p > 0, 1, -1)
        if angle:
            channel = np.searchsorted(POLARIZER_ANGLES_DEG[:-1], angle[0])
            known = np.array(POLARIZER_ANGLES_DEG)[channel] == angle[0]
            self.counts["bad_angle"] += int(np.count_nonzero(good & ~known))
            good &= known
            p *= 1 + channel  # the clock sorts the columns of `Block` alone, so p holds the channel too
        x, y, p = (column[good].astype(dtype) for column, dtype in ((x, np.int16), (y, np.int16), (p, np.int8)))
        for ready in self._clock.ordered(Block(t[good], x, y, p), final=flush):
            if len(ready.t):
                yield self._channels(ready), self._since

    def _channels(self, block: Block) -> list[Events]:
        if self._mosaic:
            return split_mosaic(self._events(block), self._mosaic)
        channel = np.abs(block.p)
        return [self._events(block.rows(channel == 1 + k)) for k in range(len(POLARIZER_ANGLES_DEG))]

    def _events(self, block: Block) -> Events:
        t, x, y, p = map(torch.from_numpy, block)
        return Events(t, x, y, p.sign(), *self._sensor)


class LiveLines:
    """Read lines as they arrive, in pieces; ends with the input.

    Unusable lines and events with wrong times are left out and counted in `counts`. RecordingError where more than 1 %
    of the lines (and 8) are unusable for the same reason, or where the first line is not a size. The source is closed
    at its end, unless it is standard input.
    """

    def __init__(self, source: BinaryIO, name: str, mosaic: Mosaic | None):
        self.name = name
        self._source, self._columns = source, 4 if mosaic else 5
        self.waits = stat.S_ISREG(os.fstat(source.fileno()).st_mode)
        self._queue: Queue[tuple[bytes, float] | None] = Queue(
            MAX_READ_AHEAD // (READ_BYTES if self.waits else PIPE_BYTES)
        )
        own = os.dup(source.fileno())  # a duplicate, so that a file opened later cannot get its number
        Thread(target=self._read, args=[own], daemon=True).start()
        self._stream: _Stream | None = None
        self._lines = self._whole_lines()
        self._sensor = self._size()
        self._stream = _Stream(name, *self._sensor, mosaic)
        self.height, self.width, self.counts = self._stream.height, self._stream.width, self._stream.counts

    def __iter__(self) -> Iterator[Piece]:
        return pieces_of(self._blocks())

    def _blocks(self) -> Iterator[tuple[list[Events], float]]:
        assert self._stream is not None
        shift, lines = np.zeros(self._columns, np.int64), 0
        nothing = np.empty((0, self._columns), np.int64)
        for data, read_at in self._lines:
            rows = [nothing, *rows_of(data, shift, self.counts, "unreadable_lines")]
            lines += data.count(b"\n")
            blocks = list(self._stream.add(np.concatenate(rows), read_at, flush=not data))
            refuse_much_damage(self.name, self.counts, lines, (*SAFE, "time_glitches"))
            yield from blocks
        yield from self._stream.add(nothing, 0.0, flush=True)

    def _size(self) -> tuple[int, int]:
        """Height and width in the first line that is no comment; what has arrived after it stays in `_lines`."""
        line = b""
        while not line.partition(b"#")[0].strip():
            data, read_at = next(self._lines, (b"", 0.0))
            if not data:
                break
            line, _, rest = data.partition(b"\n")
            self._lines = itertools.chain([(rest, read_at)] if rest else [], self._lines)
        words = [word for one in numbers_of(line) for word in one.words]
        if len(words) != 2 or not all(w.isdigit() and 0 < int(w) <= MAX_SIDE for w in words):
            raise RecordingError(f"{self.name}: expected a first line `width height` of the sensor, such as `346 260`")
        return int(words[1]), int(words[0])

    def _whole_lines(self) -> Iterator[tuple[bytes, float]]:
        """Complete lines with their time of arrival, none where events were held back for long enough.

        At the end of the input, also an incomplete last line.
        """
        rest, read_at = b"", 0.0
        while True:
            try:
                arrived = self._queue.get(timeout=self._stream.patience_s() if self._stream else None)
            except Empty:
                yield b"", time.perf_counter()
                continue
            if arrived is None:
                break
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
        try:
            while not self._source.closed and (data := os.read(descriptor, READ_BYTES)):  # the data available
                self._queue.put((data, time.perf_counter()))
        except OSError:  # the other end was closed
            return
        finally:
            os.close(descriptor)
            if self._source is not sys.stdin.buffer:
                self._source.close()
            self._queue.put(None)


class LiveCamera:
    """Events of a camera in pieces, as they arrive; ends with the connection, or after `idle_s` without an event.

    Events with wrong times are left out and counted in `counts`. RuntimeError where dv-processing is missing;
    RecordingError where the camera or program cannot be reached.
    """

    waits = False

    def __init__(self, address: str, mosaic: Mosaic, idle_s: float):
        self.name = address
        self._idle_s = idle_s
        self._reader = _opened(address)
        width, height = self._reader.getEventResolution()
        self._stream = _Stream(address, height, width, mosaic)
        self.height, self.width, self.counts = self._stream.height, self._stream.width, self._stream.counts

    def __iter__(self) -> Iterator[Piece]:
        return pieces_of(self._blocks())

    def _blocks(self) -> Iterator[tuple[list[Events], float]]:
        nothing, quiet_since = np.empty((0, 4), np.int64), time.monotonic()
        while time.monotonic() - quiet_since < self._idle_s:
            batch = self._reader.getNextEventBatch()
            if batch is not None and not batch.isEmpty():
                read_at, quiet_since = time.perf_counter(), time.monotonic()
                columns = batch.timestamps(), batch.coordinates(), batch.polarities()
                table = np.concatenate([np.array(one, np.int64).reshape(batch.size(), -1) for one in columns], axis=1)
                yield from self._stream.add(table, read_at)
            elif self._stream.patience_s() == 0:
                yield from self._stream.add(nothing, 0.0, flush=True)
            elif self._reader.isRunning():
                time.sleep(POLL_S)
            else:
                break
        yield from self._stream.add(nothing, 0.0, flush=True)


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
    """Four channels in the format of `LiveLines`: the first line, the sorted times, and the lines in that order."""
    tables = [
        np.stack([*(getattr(events, name).numpy().astype(np.int64) for name in "txyp"), np.full(len(events), angle)], 1)
        for events, angle in zip(channels, POLARIZER_ANGLES_DEG, strict=True)
    ]
    table = np.concatenate(tables)
    table = table[np.argsort(table[:, 0], kind="stable")]
    head = f"{channels[0].width} {channels[0].height}\n".encode()
    return head, table[:, 0], lines_of(table, " ")


def replay(channels: Sequence[Events], speed: float, write: Callable[[bytes], object]) -> None:
    """Write four channels in the format of `LiveLines`, at `speed` times the original pace."""
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
