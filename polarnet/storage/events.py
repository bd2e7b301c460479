"""The event store, the one on-disk format of simulated and real events: a Zarr v3 group.

Each sequence is a row. Its four channels follow each other in the columns `events/x`, `events/y`, `events/t`
(microseconds from the start of the sequence) and `events/p` (+1 or -1). `offsets` holds the start of each channel and
the end of the last; it is written last. `duration_us` is the length of the sequence. `ms_to_idx` (DSEC's name) holds,
for each channel and millisecond, the index of the first event at or after it.
"""

import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polarnet.events.stream import LARGEST_SIDE, Events, slice_count, slice_time, validate
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.table import (
    REPAIR,
    Column,
    Columns,
    Table,
    check_names,
    create_table,
    open_table,
    refuse_missing,
)

FORMAT = "polarnet.events"
VERSION = 1

CHANNELS = len(POLARIZER_ANGLES_DEG)
LONGEST_US = 2**32 - 2  # 71 minutes: t is uint32, and its largest value is the fill value
MOST_EVENTS = 2**32  # in the four channels of a sequence
CHUNK = 2**18  # events; smaller chunks make Zarr slower, for a window as well as for a whole sequence
SHARD = 2**22
MILLISECOND_CHUNK = 2**12
MILLISECOND_SHARD = 2**16

CONVENTIONS = {
    "layout": "row: sequence; its channels one after the other, from offsets[row, c] up to offsets[row, c + 1]",
    "events/x": "column, pixels",
    "events/y": "row, pixels",
    "events/t": "microseconds from the start of the sequence, not decreasing within a channel",
    "events/p": "polarity: +1 brighter, -1 darker",
    "duration_us": "length of the sequence in microseconds; no event is later",
    "ms_to_idx": "ms_to_idx[row, c, k]: place in the row of the first event of channel c with t >= 1000 k",
}


class EventStore:
    """Sequences of events in four channels; see `create` and `open`."""

    def __init__(self, table: Table):
        self._table = table
        self.path = table.path
        self.sequences: list[str] = list(table.attributes["sequences"])
        self.height: int = table.attributes["height"]
        self.width: int = table.attributes["width"]
        self.attributes: dict[str, Any] = table.attributes["attributes"]
        """Metadata given by the store's creator."""

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        sequences: Sequence[str],
        height: int,
        width: int,
        attributes: Mapping[str, Any],
    ) -> "EventStore":
        """Create a store to write; it lies at PATH.tmp until it is finished.

        `attributes` (plain JSON) must hold everything that the events depend on: an unfinished store with equal
        metadata is resumed, one with other metadata is removed. One process creates the store. It can be pickled and
        sent to other processes, which may write different sequences at the same time.
        """
        check_names(sequences)
        if not (0 < height <= LARGEST_SIDE and 0 < width <= LARGEST_SIDE):
            raise ValueError(f"expected a sensor with sides of 1 to {LARGEST_SIDE} px, got {height}x{width}")
        metadata = {
            "sequences": list(sequences),
            "height": height,
            "width": width,
            "polarizer_angles_deg": list(POLARIZER_ANGLES_DEG),
            "conventions": CONVENTIONS,
            "attributes": dict(attributes),
        }
        return cls(create_table(path, FORMAT, VERSION, metadata, _columns(metadata)))

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> "EventStore":
        """Open a finished store: a local folder, a zip, or an fsspec URL. See `polarnet.storage.table.open_table`."""
        return cls(open_table(path, FORMAT, VERSION, _columns))

    def write(self, sequence: str, channels: Sequence[Events], duration_us: int) -> None:
        """Write the four channels (0, 45, 90, 135 degrees) of a sequence.

        A sequence that is already written stays unchanged, since the store's attributes determine its events.
        ValueError, before anything is written, for events out of order, off the sensor or outside [0, duration_us].
        """
        self._check(channels, duration_us)
        if self._table.is_written("offsets", sequence):
            return
        offsets = np.cumsum([0, *map(len, channels)])
        index = [
            start + first_at_millisecond(c.t, duration_us) for start, c in zip(offsets[:-1], channels, strict=True)
        ]
        for name in "xytp":
            column = f"events/{name}"
            pieces, dtype = [getattr(channel, name).numpy() for channel in channels], self._table.columns[column].dtype
            # checked above: the narrower types on disk hold every value
            self._table.write(column, sequence, np.concatenate(pieces, dtype=dtype, casting="unsafe"))
        self._table.write("ms_to_idx", sequence, np.stack(index))
        self._table.write("duration_us", sequence, np.array(duration_us))
        self._table.write("offsets", sequence, offsets)

    def missing(self) -> list[str]:
        """Sequences not written yet."""
        return [sequence for sequence in self.sequences if not self._table.is_written("offsets", sequence)]

    def finish(self) -> None:
        """Mark the store complete and move it from PATH.tmp to PATH; ValueError where sequences are missing."""
        refuse_missing(self.path, self.missing())
        offsets = self._table.read_together([("offsets", sequence, ()) for sequence in self.sequences])
        durations = self._table.read_together([("duration_us", sequence, ()) for sequence in self.sequences])
        most, longest_us = max(int(row[-1]) for row in offsets), max(map(int, durations))
        columns = {f"events/{name}": (most,) for name in "xytp"}
        self._table.finish({**columns, "ms_to_idx": (CHANNELS, _milliseconds(longest_us))})

    def duration_us(self, sequence: str) -> int:
        """Length of a sequence in microseconds."""
        return int(self._table.read("duration_us", sequence))

    def count(self, sequence: str) -> tuple[int, ...]:
        """Number of events in each channel of a sequence."""
        return tuple(np.diff(self._offsets(sequence)).tolist())

    def read(self, sequence: str, start_us: int | None = None, stop_us: int | None = None) -> list[Events]:
        """The four channels of a sequence, whole or limited to events with start <= t < stop.

        Times always count from the start of the sequence. Reads only the chunks that overlap the window. ValueError
        names sequence and column of unreadable data.
        """
        offsets = self._offsets(sequence)
        if start_us is None and stop_us is None:
            (events,) = self._events(sequence, [(0, int(offsets[-1]))])
            return [slice_count(events, start, stop) for start, stop in itertools.pairwise(offsets.tolist())]
        start_us = max(0, start_us or 0)
        stop_us = LONGEST_US + 1 if stop_us is None else max(start_us, stop_us)
        rows = _milliseconds(self.duration_us(sequence))
        first, after = min(start_us // 1000, rows - 1), -(-stop_us // 1000)
        index = self._table.read("ms_to_idx", sequence, slice(CHANNELS), slice(first, min(after + 1, rows)))
        stops = index[:, -1] if after < rows else offsets[1:]
        spans = list(zip(index[:, 0].tolist(), stops.tolist(), strict=True))
        return [slice_time(events, start_us, stop_us) for events in self._events(sequence, spans)]

    def problems(self, sequence: str) -> list[str]:
        """Problems of a sequence: unreadable or missing data, or events that break the format's rules."""
        try:
            offsets, duration_us = self._offsets(sequence), self.duration_us(sequence)
            index = self._table.read("ms_to_idx", sequence, slice(CHANNELS), slice(_milliseconds(duration_us)))
        except ValueError as error:
            return [str(error)]
        if unreadable := self._unreadable_columns(sequence, int(offsets[-1])):
            return unreadable
        problems = []
        spans = list(itertools.pairwise(offsets.tolist()))
        channels = self._events(sequence, spans)
        for angle, (start, _), channel, row in zip(POLARIZER_ANGLES_DEG, spans, channels, index, strict=True):
            where = f"{self.path}: {sequence}, polarizer {angle}: "
            try:
                _check_channel(channel, duration_us)
            except ValueError as error:
                problems.append(where + str(error))
            if not np.array_equal(row, start + first_at_millisecond(channel.t, duration_us)):
                problems.append(f"{where}ms_to_idx does not match events/t")
        return problems

    def _unreadable_columns(self, sequence: str, events: int) -> list[str]:
        unreadable = []
        for name in "xytp":
            try:
                self._table.read(f"events/{name}", sequence, slice(events))
            except ValueError as error:
                unreadable.append(str(error))
        return unreadable

    def _offsets(self, sequence: str) -> np.ndarray:
        offsets = self._table.read("offsets", sequence)
        if offsets[0] != 0 or (np.diff(offsets) < 0).any():
            raise ValueError(f"{self.path}: {sequence}, column offsets is unreadable: {offsets.tolist()}; {REPAIR}")
        return offsets

    def _events(self, sequence: str, spans: Sequence[tuple[int, int]]) -> list[Events]:
        """The events in each of the spans (start, stop) of a sequence's row."""
        requests = [(f"events/{name}", sequence, (slice(*span),)) for span in spans for name in "txyp"]
        columns = self._table.read_together(requests)
        return [
            Events(
                torch.from_numpy(t.astype(np.int64)),
                torch.from_numpy(x.view(np.int16)),
                torch.from_numpy(y.view(np.int16)),
                torch.from_numpy(p),
                self.height,
                self.width,
            )
            for t, x, y, p in zip(*(columns[i::4] for i in range(4)), strict=True)
        ]

    def _check(self, channels: Sequence[Events], duration_us: int) -> None:
        if len(channels) != CHANNELS:
            raise ValueError(f"expected a stream for each of {CHANNELS} polarizers, got {len(channels)}")
        if not 0 < duration_us <= LONGEST_US:
            raise ValueError(f"expected a duration of 1 to {LONGEST_US} us, got {duration_us}; cut the sequence")
        for angle, channel in zip(POLARIZER_ANGLES_DEG, channels, strict=True):
            if (channel.height, channel.width) != (self.height, self.width):
                raise ValueError(
                    f"polarizer {angle}: expected a sensor of {self.height}x{self.width} px, "
                    f"got {channel.height}x{channel.width}"
                )
            try:
                _check_channel(channel, duration_us)
            except ValueError as error:
                raise ValueError(f"polarizer {angle}: {error}") from None


def verify(path: str | os.PathLike[str]) -> list[str]:
    """All problems of an event store, each with its sequence and column; empty when it is intact."""
    try:
        store = EventStore.open(path)
    except (FileNotFoundError, ValueError) as error:
        return [str(error)]
    return store._table.metadata_problems() + [problem for name in store.sequences for problem in store.problems(name)]


def _columns(metadata: Mapping[str, Any]) -> Columns:
    sequences = metadata["sequences"]

    def column(dtype: str, fill: int, shape: tuple[int, ...], chunk: tuple[int, ...], shard: tuple[int, ...]) -> Column:
        shuffle = "bitshuffle" if np.dtype(dtype).itemsize <= 2 else "shuffle"
        return Column(sequences, shape, chunk, shard, dtype, fill, fill_is_data=False, shuffle=shuffle)

    def per_event(dtype: str, fill: int) -> Column:
        return column(dtype, fill, (MOST_EVENTS,), (CHUNK,), (SHARD,))

    return {
        "events/x": per_event("uint16", 2**16 - 1),
        "events/y": per_event("uint16", 2**16 - 1),
        "events/t": per_event("uint32", 2**32 - 1),
        "events/p": per_event("int8", 0),
        "ms_to_idx": column(
            "int64",
            -1,
            (CHANNELS, _milliseconds(LONGEST_US)),
            (CHANNELS, MILLISECOND_CHUNK),
            (CHANNELS, MILLISECOND_SHARD),
        ),
        "duration_us": column("int64", -1, (), (), ()),
        "offsets": column("int64", -1, (CHANNELS + 1,), (CHANNELS + 1,), (CHANNELS + 1,)),
    }


def _milliseconds(duration_us: int) -> int:
    """Length of the time index: every full millisecond from 0 up to the first at or after the end."""
    return -(-duration_us // 1000) + 1


def first_at_millisecond(t: Tensor, duration_us: int) -> np.ndarray:
    """Number of events before each millisecond of the time index."""
    return torch.searchsorted(t, 1000 * torch.arange(_milliseconds(duration_us))).numpy()


def _check_channel(events: Events, duration_us: int) -> None:
    validate(events)
    if len(events) and not (events.t[0] >= 0 and events.t[-1] <= duration_us):
        raise ValueError(
            f"expected times from 0 to the duration of {duration_us} us, "
            f"got {int(events.t[0])} to {int(events.t[-1])} us"
        )
