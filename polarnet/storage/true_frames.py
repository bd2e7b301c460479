"""The truth of one sequence, frame by frame: from a frame store, or from the frames that `polarnet simulate` writes."""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from polarnet.storage.frames import FRAMES_PER_CHUNK, FrameStore, dequantise_angle, dequantise_fraction
from polarnet.storage.groups import open_group

APPENDED = "truth.zarr"
"""Name of the frames that `polarnet simulate` writes beside its event store."""
STORED = "frames.zarr"
"""Name of the frame store that the pipeline writes beside its event store."""


MAPS = ("s0", "dolp", "aolp")


class TrueFrame(NamedTuple):
    """True polarization on the sensor at one time."""

    s0: Float[Tensor, "h w"]
    """In [0, 1]."""
    dolp: Float[Tensor, "h w"]
    aolp: Float[Tensor, "h w"]
    """Radians in [0, pi)."""
    valid: Bool[Tensor, "h w"] | None = None
    """Where the truth is known; None: everywhere."""


class TrueFrames:
    """Frames of one sequence, read from disk in blocks.

    `t_us` are their times in microseconds from the start of the sequence; `frames[k]` is the frame at `t_us[k]`.
    """

    def __init__(self, t_us: Int64[np.ndarray, " n"], block: Callable[[int, int], list[TrueFrame]]):
        """`block(start, stop)` reads the frames from number `start` up to `stop`."""
        self.t_us = t_us
        self._block = functools.lru_cache(maxsize=2)(block)

    def __len__(self) -> int:
        return len(self.t_us)

    def __getitem__(self, number: int) -> TrueFrame:
        first = number - number % FRAMES_PER_CHUNK
        return self._block(first, min(first + FRAMES_PER_CHUNK, len(self)))[number - first]

    def has(self, t_us: int, within_us: float) -> bool:
        """Whether there is a frame at a time, give or take `within_us`."""
        return bool((np.abs(self.t_us - t_us) <= within_us).any())

    def at(self, t_us: int) -> TrueFrame:
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
    >>> store = FrameStore.create("truth", Contents({"lake": "test"}), n_frames=1, height=12, width=18)
    >>> store.write("lake", torch.tensor([0]), torch.full((1, 4, 12, 18), 0.5), *torch.zeros(2, 1, 12, 18))
    >>> store.finish()
    >>> open_truth("truth", "lake")[0].dolp.shape
    torch.Size([12, 18])
    """
    group = open_group(path)
    if group.attrs.get("format") != FrameStore.FORMAT:
        return _appended(group)
    store = FrameStore.open(path)
    return _stored(store, sequence)


def _appended(group: zarr.Group) -> TrueFrames:
    arrays: dict[str, Any] = dict(group.arrays())
    if missing := {"t_us", *MAPS} - arrays.keys():
        raise ValueError(f"{group.store_path}: expected true frames, {', '.join(sorted(missing))} is missing")

    def block(start: int, stop: int) -> list[TrueFrame]:
        s0, dolp, aolp = (np.asarray(arrays[name][start:stop]) for name in MAPS)
        return [*map(TrueFrame, dequantise_fraction(s0), dequantise_fraction(dolp), dequantise_angle(aolp))]

    return TrueFrames(np.asarray(arrays["t_us"][:]), block)


def _stored(store: FrameStore, sequence: str) -> TrueFrames:
    def block(start: int, stop: int) -> list[TrueFrame]:
        _, intensity, dolp, aolp, valid = store.frames(sequence, start, stop)
        i0, _, i90, _ = intensity.unbind(1)
        return [*map(TrueFrame, i0 + i90, dolp, aolp, [None] * len(dolp) if valid is None else valid)]

    return TrueFrames(store.t_us(sequence).numpy(), block)
