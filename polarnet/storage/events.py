"""The event store, the one on-disk format of simulated and real events.

The four channels of a sequence follow each other in the columns `events/x`, `events/y`, `events/t` (microseconds from
the start of the sequence) and `events/p` (+1 or -1). A sequence's record holds `offsets`, the start of each channel and
the end of the last, and `duration_us`, its length. If the sequence drew parameters of its camera, `drawn` holds their
values. `ms_to_idx` (DSEC's name) holds, for each millisecond and channel, the index of the first event at or after it.
"""

import functools
import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polarnet.events.stream import MAX_SIDE, Events, slice_count, slice_time, validate
from polarnet.stokes import POLARIZER_ANGLES_DEG
from polarnet.storage.groups import Column, Columns
from polarnet.storage.parts import Store

CHANNELS = len(POLARIZER_ANGLES_DEG)
MAX_DURATION_US = 2**32 - 1  # 71 minutes: t is uint32
CHUNK = 2**18  # events; smaller chunks make Zarr slower, for a window as well as for a whole sequence
MILLISECOND_CHUNK = 2**12
NAMES = ("t", "x", "y", "p")

CONVENTIONS = {
    "layout": "a sequence's channels one after the other, from offsets[c] up to offsets[c + 1] of its rows",
    "events/x": "column, pixels",
    "events/y": "row, pixels",
    "events/t": "microseconds from the start of the sequence, not decreasing within a channel",
    "events/p": "polarity: +1 brighter, -1 darker",
    "duration_us": "length of the sequence in microseconds; no event is later",
    "ms_to_idx": "ms_to_idx[k, c]: place in the sequence's rows of the first event of channel c with t >= 1000 k",
}


class EventStore(Store):
    """Sequences of events in four channels; see `create` and `open`.

    >>> from polarnet.events import Events
    >>> from polarnet.storage import EventStore
    >>> store = EventStore.create("events.zarr", ["lake"], height=120, width=180, attributes={})
    >>> store.write("lake", [Events.empty(120, 180)] * 4, duration_us=1_000_000)
    >>> store.finish()
    >>> EventStore.open("events.zarr").count("lake")
    (0, 0, 0, 0)
    """

    FORMAT = "polarnet.events"
    VERSION = 4
    height: int
    width: int

    @functools.cached_property
    def columns(self) -> Columns:
        """The events, and the index of their times."""
        types = {"x": "uint16", "y": "uint16", "t": "uint32", "p": "int8"}
        columns = {f"events/{name}": Column("events", types[name], CHUNK) for name in types}
        return {**columns, "ms_to_idx": Column("milliseconds", "int64", MILLISECOND_CHUNK, (CHANNELS,))}

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        sequences: Sequence[str],
        height: int,
        width: int,
        attributes: Mapping[str, Any],
        sequences_per_part: int = 1,
    ) -> "EventStore":
        """Create a store to write; it lies at PATH.tmp until it is finished.

        `attributes` (plain JSON) must hold everything that the events depend on: an unfinished store with equal
        metadata is resumed, one with other metadata is removed. One process creates the store. It can be pickled and
        sent to other processes, which may write different parts at the same time.
        """
        if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
            raise ValueError(f"expected a sensor with sides of 1 to {MAX_SIDE} px, got {height}x{width}")
        return cls.create_parts(
            path,
            sequences,
            attributes,
            sequences_per_part,
            height=height,
            width=width,
            polarizer_angles_deg=list(POLARIZER_ANGLES_DEG),
            conventions=CONVENTIONS,
        )

    def write(
        self, sequence: str, channels: Sequence[Events], duration_us: int, drawn: Mapping[str, Any] | None = None
    ) -> None:
        """Write the four channels (0, 45, 90, 135 degrees) of the next sequence of a part; see `Store.append`.

        `drawn` (plain JSON) are the camera parameters drawn for this sequence. A sequence that is already written stays
        unchanged, since the store's attributes determine its events.
        ValueError, before anything is written, for events out of order, off the sensor or outside [0, duration_us].
        """
        self._check(channels, duration_us)
        if self.is_written(sequence):
            return
        offsets = np.cumsum([0, *map(len, channels)])
        columns = {}
        for name in NAMES:
            pieces = [getattr(channel, name).numpy() for channel in channels]
            dtype = self.columns[f"events/{name}"].dtype  # narrower, but holds every value that `_check` accepts
            columns[f"events/{name}"] = np.concatenate(pieces, dtype=dtype, casting="unsafe")
        counts = [first_at_millisecond(channel.t, duration_us) for channel in channels]
        columns["ms_to_idx"] = np.stack(counts, axis=1) + offsets[:-1]
        record = {"offsets": offsets.tolist(), "duration_us": int(duration_us)}
        self.append(sequence, columns, record | ({"drawn": dict(drawn)} if drawn else {}))

    def duration_us(self, sequence: str) -> int:
        """Length of a sequence in microseconds."""
        return self.record(sequence)["duration_us"]

    def drawn(self, sequence: str) -> dict[str, Any]:
        """Values of the camera's parameters that the sequence drew, by section of params.yaml; empty if none."""
        return self.record(sequence).get("drawn", {})

    def count(self, sequence: str) -> tuple[int, ...]:
        """Number of events in each channel of a sequence."""
        return tuple(np.diff(self.record(sequence)["offsets"]).tolist())

    def read(self, sequence: str, start_us: int | None = None, stop_us: int | None = None) -> list[Events]:
        """The four channels of a sequence, whole or limited to events with start <= t < stop.

        Times always count from the start of the sequence. Reads only the chunks that overlap the window. ValueError
        names sequence and column of unreadable data.
        """
        offsets = self.record(sequence)["offsets"]
        if start_us is None and stop_us is None:
            (events,) = self._events(sequence, [(0, offsets[-1])])
            return [slice_count(events, start, stop) for start, stop in itertools.pairwise(offsets)]
        start_us = max(0, start_us or 0)
        stop_us = MAX_DURATION_US + 1 if stop_us is None else max(start_us, stop_us)
        rows = _milliseconds(self.duration_us(sequence))
        first, after = min(start_us // 1000, rows - 1), -(-stop_us // 1000)
        index = self.read_column("ms_to_idx", sequence, first, after + 1)
        stops = index[-1].tolist() if after < rows else offsets[1:]
        spans = list(zip(index[0].tolist(), stops, strict=True))
        return [slice_time(events, start_us, stop_us) for events in self._events(sequence, spans)]

    def problems(self, sequence: str) -> list[str]:
        """Problems of a sequence: unreadable or missing data, or events that break the format's rules."""
        if problems := super().problems(sequence):
            return problems
        offsets, duration_us = self.record(sequence)["offsets"], self.duration_us(sequence)
        channels = self._events(sequence, list(itertools.pairwise(offsets)))
        index = self.read_column("ms_to_idx", sequence)
        for angle, start, channel, places in zip(POLARIZER_ANGLES_DEG, offsets, channels, index.T, strict=False):
            where = f"{self.path}: {sequence}, polarizer {angle}: "
            try:
                _check_channel(channel, duration_us)
            except ValueError as error:
                problems.append(where + str(error))
            if not np.array_equal(places, start + first_at_millisecond(channel.t, duration_us)):
                problems.append(f"{where}ms_to_idx does not match events/t")
        return problems

    def _events(self, sequence: str, spans: Sequence[tuple[int, int]]) -> list[Events]:
        """The events in each of the spans (start, stop) of a sequence's rows."""
        columns = self.read_columns(sequence, [(f"events/{name}", *span) for span in spans for name in NAMES])
        return [
            Events(
                torch.from_numpy(t.astype(np.int64)),
                torch.from_numpy(x.view(np.int16)),
                torch.from_numpy(y.view(np.int16)),
                torch.from_numpy(p),
                self.height,
                self.width,
            )
            for t, x, y, p in zip(*(columns[i :: len(NAMES)] for i in range(len(NAMES))), strict=True)
        ]

    def _check(self, channels: Sequence[Events], duration_us: int) -> None:
        if len(channels) != CHANNELS:
            raise ValueError(f"expected a channel for each of {CHANNELS} polarizers, got {len(channels)}")
        if not 0 < duration_us <= MAX_DURATION_US:
            raise ValueError(f"expected a duration of 1 to {MAX_DURATION_US} us, got {duration_us}; cut the sequence")
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


def _milliseconds(duration_us: int) -> int:
    """Number of rows of the time index: milliseconds from 0 up to the first at or after the end."""
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
