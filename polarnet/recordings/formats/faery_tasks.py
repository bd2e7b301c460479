"""Tasks of the faery process; see `isolated_worker`."""

from collections.abc import Callable, Iterator
from typing import Any

import faery
import numpy as np


def size(path: str, file_type: str) -> tuple[int, int]:
    """Height and width of the sensor."""
    width, height = faery.events_stream_from_file(path, file_type=file_type).dimensions()
    return height, width


def pieces(path: str, file_type: str) -> Iterator[np.ndarray]:
    """Packets of events: structured arrays with the fields t, x, y, on."""
    return iter(faery.events_stream_from_file(path, file_type=file_type))


def frames(path: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and grey levels of all frames; None if there are none, or if they differ in size."""
    times, levels = [], []
    for track, packet in faery.aedat.Decoder(path):
        if track.data_type == "frame" and packet.pixels.ndim == 2:
            start, end = packet.exposure_start_t, packet.exposure_end_t
            times.append((start + end) // 2 if 0 < start < end else packet.t)
            levels.append(packet.pixels)
    return (np.array(times), np.stack(levels)) if len({one.shape for one in levels}) == 1 else None


TASKS: dict[str, Callable[..., Any]] = {"size": size, "pieces": pieces, "frames": frames}
