"""Read events live from a camera with a polarizer mosaic, through the package dv-processing.

dv://HOST:PORT is a running acquisition program that streams events over the network (DV, dv-runtime, or another
program with a NetworkWriter); dv://camera is the first camera of iniVation that is plugged in.
"""

import re
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from polarnet.events.mosaic import split_mosaic
from polarnet.events.stream import Events
from polarnet.recordings.live import POLL_S, Piece, StreamClock
from polarnet.recordings.source import RecordingError
from polarnet.stokes import Mosaic
from polarnet.terminal.installation import installation

SCHEME, CAMERA = "dv://", "camera"
NETWORK = re.compile(r"(?P<host>[^:/]+):(?P<port>\d{1,5})")


class LiveCamera:
    """Events of a camera in pieces, as they arrive; ends with the connection, or after `idle_s` without an event.

    Events older than the last one of an earlier piece are left out and counted in `counts`. RuntimeError where
    dv-processing is missing; RecordingError where the camera or program cannot be reached.
    """

    def __init__(self, address: str, mosaic: Mosaic, idle_s: float):
        self.name = address
        self.counts: Counter[str] = Counter()
        self._mosaic, self._idle_s = mosaic, idle_s
        self._reader = _opened(address)
        width, height = self._reader.getEventResolution()
        self._sensor = height, width
        self.height, self.width = height // 2, width // 2

    def __iter__(self) -> Iterator[Piece]:
        clock, quiet_since = StreamClock(), time.monotonic()
        while time.monotonic() - quiet_since < self._idle_s:
            batch = self._reader.getNextEventBatch()
            if batch is None or batch.isEmpty():
                if not self._reader.isRunning():
                    return
                time.sleep(POLL_S)
                continue
            read_at, quiet_since = time.perf_counter(), time.monotonic()
            x, y = np.array(batch.coordinates(), np.int64).reshape(-1, 2).T
            p = np.where(np.array(batch.polarities()).ravel() > 0, 1, -1)
            t, current = clock.on_time(np.array(batch.timestamps(), np.int64).ravel())
            self.counts["late"] += int(np.count_nonzero(~current))
            if current.any():
                events = Events.from_columns(t[current], x[current], y[current], p[current], *self._sensor)
                yield Piece(split_mosaic(events, self._mosaic), clock.until_us, read_at)


def _opened(address: str) -> Any:
    """The camera, or the connection to a program."""
    try:
        import dv_processing
    except ImportError:
        raise RuntimeError(f"{address} needs dv-processing: {installation('live')}") from None
    place = address.removeprefix(SCHEME)
    network = NETWORK.fullmatch(place)
    if network is None and place != CAMERA:
        raise ValueError(f"expected {SCHEME}HOST:PORT or {SCHEME}{CAMERA}, got {address}")
    try:
        reader = dv_processing.io.NetworkReader(network["host"], int(network["port"])) if network else (
            dv_processing.io.camera.open()
        )  # fmt: skip
    except RuntimeError as error:
        raise RecordingError(f"{address} cannot be reached: {error}; is it running, and does it stream?") from None
    if not reader.isEventStreamAvailable():
        raise RecordingError(f"{address}: expected a stream of events, there is none; choose another output")
    return reader
