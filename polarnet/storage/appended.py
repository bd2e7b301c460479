"""A Zarr group of frames that grows while they arrive, in constant memory."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import BloscCodec

FRAMES_PER_CHUNK = 32
CODEC = BloscCodec(cname="lz4", shuffle="shuffle")


class AppendedFrames:
    """Zarr arrays of equal length, one row per frame; the first frame decides their names, shapes and types.

    `conventions` explains each name, and is stored in the group's attributes for the names in use. Nothing is written
    before the first frame.
    """

    def __init__(self, path: Path, conventions: Mapping[str, str]):
        self.path, self.conventions = path, conventions
        self._arrays: dict[str, zarr.Array] = {}
        self._buffer: dict[str, list[np.ndarray]] = {}

    def add(self, frame: Mapping[str, np.ndarray]) -> None:
        """Add one frame: the row of each array by name. A full chunk of frames is written to disk."""
        for name, values in frame.items():
            self._buffer.setdefault(name, []).append(values)
        if len(next(iter(self._buffer.values()))) == FRAMES_PER_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write the frames that are still in memory."""
        if not self._buffer:
            return
        if not self._arrays:
            group = zarr.open_group(self.path, mode="w")
            group.attrs["conventions"] = {name: self.conventions[name] for name in self._buffer}
            for name, (first, *_) in self._buffer.items():
                chunks = (FRAMES_PER_CHUNK, *first.shape)
                self._arrays[name] = group.create_array(
                    name, shape=(0, *first.shape), chunks=chunks, dtype=first.dtype, compressors=CODEC
                )
        for name, values in self._buffer.items():
            self._arrays[name].append(np.stack(values))
        self._buffer.clear()
