"""Opens four files (one a polarizer), one file with a mosaic, or one without polarizers, as channels in pieces.

The four files share one clock. A piece has bounded length, so memory does not grow with the files.
`polarnet.captures.targets` handles division-of-time captures, each with its own clock.
"""

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from polarnet.events.stream import Events, shifted, slice_count, split_mosaic
from polarnet.recordings.recording import RecordingReader, log_repairs, open_recording, whole
from polarnet.recordings.source import Counts, RecordingError
from polarnet.stokes import POLARIZER_ANGLES_DEG, Mosaic

Open = Callable[[Path], RecordingReader]
"""`open_recording`, with options where a file needs some."""


class Piece(NamedTuple):
    """The events of all channels that follow those of the previous piece."""

    channels: Sequence[Events]
    """Times count from the first event of the input."""
    until_us: int
    """Every later piece holds only events at or after this time."""
    read_at: float
    """When its first data arrived, by `time.perf_counter`."""


class Input(NamedTuple):
    """Events of channels of equal size, piece by piece."""

    name: str
    height: int
    width: int
    pieces: Iterable[Piece]
    """Those of files can be read again from the start; RecordingError where a file turns out to be damaged."""
    repairs: Sequence[tuple[str, Counts]] = ()
    """Unusable events of each file by kind (`polarnet.recordings.source.REPAIRS`), counted while `pieces` are read."""
    channels: int = len(POLARIZER_ANGLES_DEG)
    """4, or 1 for a camera without polarizers or behind a rotating one."""
    live: bool = False
    """Whether each frame is wanted as soon as its last event has arrived; otherwise windows are predicted together."""
    waits: bool = True
    """Whether the source waits until it is read. Windows of a live one that does not are joined if need be."""
    unread: Callable[[], bool] = lambda: False
    """Whether more has arrived from a live source than `pieces` have given."""

    def shares_read(self) -> dict[str, str]:
        """The part of the files that is read, in words; empty where their formats do not tell."""
        shares = [counts.share_read for _, counts in self.repairs]
        return {"read": f"{sum(shares) / len(shares):.0%}"} if any(shares) else {}

    def whole(self) -> list[Events]:
        """All events; logs a warning for each kind of damage."""
        channels = whole((piece.channels for piece in self.pieces), self.height, self.width, self.channels)
        for name, counts in self.repairs:
            log_repairs(name, counts)
        return channels


Blocks = Callable[[], Iterator[Sequence[Events]]]
"""Reads the events of all channels in blocks, each with no event before the last one of the previous block."""


@dataclass(frozen=True)
class FilePieces:
    """Pieces of files, again at each iteration; time 0 is `origin_us` (None: the first event)."""

    blocks: Blocks
    origin_us: int | None = None

    def __iter__(self) -> Iterator[Piece]:
        piece = None
        for piece in pieces_of(((block, time.perf_counter()) for block in self.blocks()), self.origin_us):
            yield piece
        if piece is not None:  # the end of the input completes the time of the last event
            nothing = [slice_count(events, 0, 0) for events in piece.channels]
            yield Piece(nothing, piece.until_us + 1, time.perf_counter())


def _files(readers: Sequence[RecordingReader], height: int, width: int, blocks: Blocks) -> Input:
    repairs = [(reader.path.name, reader.repairs) for reader in readers]
    return Input(", ".join(name for name, _ in repairs), height, width, FilePieces(blocks), repairs)


def pieces_of(blocks: Iterable[tuple[Sequence[Events], float]], origin_us: int | None = None) -> Iterator[Piece]:
    """Pieces of blocks of channels and their times of arrival; time 0 is `origin_us` (None: the first event)."""
    until_us = 0
    for channels, read_at in blocks:
        filled = [events.t for events in channels if len(events)]
        if filled:
            origin_us = min(int(t[0]) for t in filled) if origin_us is None else origin_us
            until_us = max(until_us, *(int(t[-1]) - origin_us for t in filled))
        if origin_us is not None:
            yield Piece([shifted(events, origin_us) for events in channels], until_us, read_at)


def open_four(files: Mapping[int, str | os.PathLike[str]], open_file: Open = open_recording) -> Input:
    """The channels of `read_four`, in pieces."""
    by_angle = {angle % 180: angle for angle in files}
    if sorted(by_angle) != list(POLARIZER_ANGLES_DEG) or len(by_angle) != len(files):
        raise RecordingError(f"expected one file for each of 0, 45, 90 and 135 degrees, got {sorted(files)}")
    readers = [open_file(Path(files[by_angle[angle]])) for angle in POLARIZER_ANGLES_DEG]
    sizes = {(reader.height, reader.width) for reader in readers}
    if len(sizes) > 1:
        raise RecordingError(f"expected four files of one size of sensor, got {sorted(sizes)} (height, width)")
    nothing = Events.empty(*sizes.pop())
    return _files(readers, nothing.height, nothing.width, lambda: _together(map(iter, readers), nothing))


def _together(streams: Iterable[Iterator[Events]], nothing: Events) -> Iterator[list[Events]]:
    """Blocks of streams on one clock: each ends with the chunk that ends first, and the next one of it is read."""
    streams = list(streams)
    heads = [next(stream, nothing) for stream in streams]
    while any(map(len, heads)):
        until_us = min(int(head.t[-1]) for head in heads if len(head))
        places = [int(np.searchsorted(head.t.numpy(), until_us, side="right")) for head in heads]
        yield [slice_count(head, 0, place) for head, place in zip(heads, places, strict=True)]
        rests = [slice_count(head, place, len(head)) for head, place in zip(heads, places, strict=True)]
        heads = [rest if len(rest) else next(stream, nothing) for rest, stream in zip(rests, streams, strict=True)]


def read_four(files: Mapping[int, str | os.PathLike[str]]) -> list[Events]:
    """The four channels, in the order 0, 45, 90, 135 degrees, from files keyed by polarizer angle.

    Angles are in degrees and count modulo 180. The files share one clock, whose time 0 is the earliest of all events.
    RecordingError where an angle is missing or duplicated, or where the sensor sizes differ.

    >>> from pathlib import Path
    >>> from polarnet.recordings import read_four
    >>> size = Path("night.txt").write_text("40 30\\n0.5 3 2 1\\n")
    >>> [len(channel) for channel in read_four(dict.fromkeys((0, 45, 90, 135), "night.txt"))]
    [1, 1, 1, 1]
    """
    return open_four(files).whole()


def open_mosaic(path: str | os.PathLike[str], mosaic: Mosaic, open_file: Open = open_recording) -> Input:
    """The channels of `read_mosaic`, in pieces."""
    reader = open_file(Path(path))
    one = split_mosaic(Events.empty(reader.height, reader.width), mosaic)[0]
    return _files([reader], one.height, one.width, lambda: (split_mosaic(events, mosaic) for events in reader))


def read_mosaic(path: str | os.PathLike[str], mosaic: Mosaic) -> list[Events]:
    """The four channels (0, 45, 90, 135 degrees) of a file of a camera with a mosaic; time 0 is its first event.

    >>> from pathlib import Path
    >>> from polarnet.recordings import read_mosaic
    >>> size = Path("night.txt").write_text("40 30\\n0.5 3 2 1\\n")
    >>> [len(channel) for channel in read_mosaic("night.txt", ((90, 45), (135, 0)))]
    [0, 1, 0, 0]
    """
    return open_mosaic(path, mosaic).whole()


def open_plain(path: Path, open_file: Open = open_recording) -> Input:
    """One channel in pieces: all events of a camera without polarizers."""
    reader = open_file(path)
    source = _files([reader], reader.height, reader.width, lambda: ([events] for events in reader))
    return source._replace(channels=1)
