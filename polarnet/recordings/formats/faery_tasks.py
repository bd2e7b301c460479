"""Tasks of faery; see `isolated_worker`."""

from collections.abc import Iterator

import faery
import numpy as np

from polarnet.recordings.formats.isolated_worker import gathered


def size(path: str, file_type: str) -> Iterator[tuple[tuple[int, int], list]]:
    """Height and width of the sensor."""
    width, height = faery.events_stream_from_file(path, file_type=file_type).dimensions()
    yield (height, width), []


def events(path: str, file_type: str) -> Iterator[tuple[None, list[np.ndarray]]]:
    """Columns t, x, y and polarity (1 or 0) of the events."""
    for table in gathered(iter(faery.events_stream_from_file(path, file_type=file_type))):
        yield None, [table["t"], table["x"], table["y"], table["on"].astype(np.uint8)]


def frames(path: str) -> Iterator[tuple[None, list[np.ndarray]]]:
    """Times and grey levels of all frames; no arrays if there are none, or if they differ in size."""
    times, levels = [], []
    for track, packet in faery.aedat.Decoder(path):
        if track.data_type == "frame" and packet.pixels.ndim == 2:
            start, end = packet.exposure_start_t, packet.exposure_end_t
            times.append((start + end) // 2 if 0 < start < end else packet.t)
            levels.append(packet.pixels)
    same_size = len({one.shape for one in levels}) == 1
    yield None, [np.array(times), np.stack(levels)] if same_size else []


TASKS = {"size": size, "events": events, "frames": frames}
