"""The truth of one sequence, frame by frame: from a frame store, or from the frames that `polarnet simulate` writes."""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from polarnet.storage.frames import FRAMES_PER_CHUNK, FrameStore, Polarization, dequantise
from polarnet.storage.groups import open_group

APPENDED = "truth.zarr"
"""Name of the frames that `polarnet simulate` writes beside its event store."""
STORED = "frames.zarr"
"""Name of the frame store that the pipeline writes beside its event store."""
MAPS = ("s0", "dolp", "aolp")


class TrueFrames:
    """Frames of one sequence, read from disk in blocks.

    `t_us` are their times in microseconds from the start of the sequence; `frames[k]` is the frame at `t_us[k]`.
    """

    def __init__(self, t_us: Int64[np.ndarray, " n"], block: Callable[[int, int], list[Polarization]]):
        """`block(start, stop)` reads the frames from number `start` up to `stop`."""
        self.t_us = t_us
        self._block = functools.lru_cache(maxsize=2)(block)

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, number: int) -> Polarization:
        first = number - number % FRAMES_PER_CHUNK
        return self._block(first, min(first + FRAMES_PER_CHUNK, len(self)))[number - first]

    def has(self, t_us: int, within_us: float) -> bool:
        """Whether there is a frame at a time, give or take `within_us`."""
        return bool((np.abs(self.t_us - t_us) <= within_us).any())

    def at(self, t_us: int) -> Polarization:
        """The frame closest to a time."""
        return self[int(np.abs(self.t_us - t_us).argmin())]


def truth_beside(store: str | os.PathLike[str]) -> Path | None:
    """The true frames in the folder of an event store; None if there are none."""
    folder = Path(store).resolve().parent
    return next((folder / name for name in (APPENDED, STORED) if (folder / name).exists()), None)


def open_truth(path: str | os.PathLike[str], sequence: str) -> TrueFrames:
    """Open the true frames of a sequence; ValueError if a frame store lacks the sequence.

    >>> import torch
    >>> from polarnet.storage import Contents, FrameStore, open_truth
    >>> store = FrameStore.create("truth", Contents({"lake": "test"}), height=12, width=18)
    >>> store.write("lake", torch.tensor([0]), torch.full((1, 4, 12, 18), 0.5), *torch.zeros(2, 1, 12, 18))
    >>> store.finish()
    >>> open_truth("truth", "lake")[0].dolp.shape
    torch.Size([12, 18])
    """
    group = open_group(path)
    if group.attrs.get("format") == FrameStore.FORMAT:
        store = FrameStore.open(path)

        def stored(start: int, stop: int) -> list[Polarization]:
            _, intensity, dolp, aolp, valid = store.frames(sequence, start, stop)
            i0, _, i90, _ = intensity.unbind(1)
            return [*map(Polarization, i0 + i90, dolp, aolp, [None] * len(dolp) if valid is None else valid)]

        return TrueFrames(store.t_us(sequence).numpy(), stored)
    arrays: dict[str, Any] = dict(group.arrays())
    if missing := {"t_us", *MAPS} - arrays.keys():
        raise ValueError(f"{group.store_path}: expected true frames, {', '.join(sorted(missing))} is missing")

    def appended(start: int, stop: int) -> list[Polarization]:
        return [*map(Polarization, *(dequantise(name, np.asarray(arrays[name][start:stop])) for name in MAPS))]

    return TrueFrames(np.asarray(arrays["t_us"][:]), appended)
