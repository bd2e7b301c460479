"""Events of a sequence on disk while they arrive: a file for each column of each channel, read as memory maps."""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
import torch

from polarnet.events.stream import Events

TYPES: dict[str, type[np.generic]] = {"t": np.int64, "x": np.int16, "y": np.int16, "p": np.int8}


class EventSpool:
    """Writer of consecutive pieces of a sequence's channels to `folder`; as a context manager it closes its files."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._files: list[dict[str, IO[bytes]]] = []
        self._size = (0, 0)
        folder.mkdir(parents=True)

    def __enter__(self) -> "EventSpool":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for columns in self._files:
            for file in columns.values():
                file.close()

    def append(self, channels: Sequence[Events]) -> None:
        """Add a piece of every channel."""
        if not self._files:
            self._size = channels[0].height, channels[0].width
            self._files = [{name: self._path(k, name).open("wb") for name in TYPES} for k in range(len(channels))]
        for columns, events in zip(self._files, channels, strict=True):
            for name, file in columns.items():
                file.write(getattr(events, name).numpy().tobytes())

    def channels(self) -> list[Events]:
        """All events so far; their columns stay on disk until they are used."""
        for columns in self._files:
            for file in columns.values():
                file.flush()
        return [self._channel(k) for k in range(len(self._files))]

    def _channel(self, channel: int) -> Events:
        columns = {name: torch.from_numpy(_mapped(self._path(channel, name), dtype)) for name, dtype in TYPES.items()}
        return Events(**columns, height=self._size[0], width=self._size[1])

    def _path(self, channel: int, name: str) -> Path:
        return self.folder / f"{channel}.{name}"


def _mapped(path: Path, dtype: type[np.generic]) -> np.ndarray:
    """The column in a file, in memory that torch may write to; a memory map cannot be empty."""
    return np.memmap(path, dtype, mode="c") if path.stat().st_size else np.empty(0, dtype)
