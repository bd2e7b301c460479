"""Tasks of the faery process; see `isolated_worker`."""

from collections.abc import Callable, Iterator
from typing import Any

import faery
import numpy as np

GATHERED_EVENTS = 2**16  # per answer; the packets of a file are small

streams: dict[int, tuple[int, Iterator[np.ndarray]]] = {}
"""Open files by reader number: the number of blocks returned so far, and the remaining packets."""


def size(path: str, file_type: str) -> tuple[int, int]:
    """Height and width of the sensor."""
    width, height = faery.events_stream_from_file(path, file_type=file_type).dimensions()
    return height, width


def block(path: str, file_type: str, reader: int, number: int) -> list[np.ndarray] | None:
    """Columns t, x, y, on of a reader's next block; None after the last.

    `number` counts the blocks already returned. If the process crashed on another file in between, they are read again.
    """
    done, packets = streams.get(reader, (-1, iter(())))
    if done != number:
        packets = iter(faery.events_stream_from_file(path, file_type=file_type))
        for _ in range(number):
            gathered(packets)
    batch = gathered(packets)
    streams[reader] = number + 1, packets
    return [np.concatenate([packet[name] for packet in batch]) for name in ("t", "x", "y", "on")] if batch else None


def frames(path: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and grey levels of all frames; None if there are none, or if they differ in size."""
    times, levels = [], []
    for track, packet in faery.aedat.Decoder(path):
        if track.data_type == "frame" and packet.pixels.ndim == 2:
            start, end = packet.exposure_start_t, packet.exposure_end_t
            times.append((start + end) // 2 if 0 < start < end else packet.t)
            levels.append(packet.pixels)
    return (np.array(times), np.stack(levels)) if len({one.shape for one in levels}) == 1 else None


def gathered(packets: Iterator[np.ndarray]) -> list[np.ndarray]:
    """Packets with about as many events as an answer holds; empty at the end."""
    batch, count = [], 0
    while count < GATHERED_EVENTS and (packet := next(packets, None)) is not None:
        batch.append(packet)
        count += len(packet)
    return batch


def close(path: str, reader: int) -> None:
    """Release the file."""
    streams.pop(reader, None)


TASKS: dict[str, Callable[..., Any]] = {"size": size, "block": block, "frames": frames, "close": close}
