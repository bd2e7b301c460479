"""The event store, the one on-disk format of simulated and real events."""

import bisect
import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float32
from pydantic import Field, PositiveInt
from torch import Tensor

from polarnet.events.stream import MAX_SIDE, Events, slice_count, slice_time, validate
from polarnet.stokes import NUM_CHANNELS, POLARIZER_ANGLES_DEG
from polarnet.storage.groups import REPAIR
from polarnet.storage.parts import Header, Store

MAX_DURATION_US = 2**32 - 1  # 71 minutes: t is uint32
INDEX_STEP = 2**14  # events
COLUMNS = {"t": "uint32", "x": "uint16", "y": "uint16", "p": "int8"}

ANALYZER = "analyzer"

CONVENTIONS = {
    "layout": "a sequence's channels one after the other, from offsets[c] up to offsets[c + 1] of its rows",
    "x": "column, pixels",
    "y": "row, pixels",
    "t": "microseconds from the start of the sequence, not decreasing within a channel",
    "p": "polarity: +1 brighter, -1 darker",
    "duration_us": "length of the sequence in microseconds; no event is later",
    "index": f"index[c][k]: time of event {INDEX_STEP} k of channel c",
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
    VERSION = 5
    chunk = 2**18  # events; smaller chunks make Zarr slower, for a window as well as for a whole sequence
    height: Annotated[PositiveInt, Field(le=MAX_SIDE)]
    width: Annotated[PositiveInt, Field(le=MAX_SIDE)]

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
        """Create a store to write, or resume it; see `Store.create_parts`."""
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
        self,
        sequence: str,
        channels: Sequence[Events],
        duration_us: int,
        drawn: Mapping[str, Any] | None = None,
        analyzer: Float32[Tensor, "4 3 *pixels"] | None = None,
    ) -> None:
        """Write the four channels (0, 45, 90, 135 degrees) of the next sequence of a part; see `Store.append`.

        `drawn` (plain JSON) are the camera parameters drawn for this sequence, `analyzer` the weights of S0, S1 and S2
        behind each channel's polarizer, or behind each of its pixels. ValueError, before anything is written, for
        events out of order, off the sensor or outside [0, duration_us], and for analyzers of another shape.
        """
        sizes = (NUM_CHANNELS, 3), (NUM_CHANNELS, 3, self.height, self.width)
        if analyzer is not None and analyzer.shape not in sizes:
            raise ValueError(f"expected analyzers of shape {sizes[0]} or {sizes[1]}, got {tuple(analyzer.shape)}")
        self._check(channels, duration_us)
        columns = {}
        for name, dtype in COLUMNS.items():  # narrower types, which hold every value that `_check` accepts
            pieces = [getattr(channel, name).numpy() for channel in channels]
            columns[name] = np.concatenate(pieces, dtype=dtype, casting="unsafe")
        record: dict[str, Any] = {
            "offsets": np.cumsum([0, *map(len, channels)]).tolist(),
            "duration_us": int(duration_us),
            "index": [channel.t[::INDEX_STEP].tolist() for channel in channels],
        }
        record |= {"drawn": dict(drawn)} if drawn else {}
        maps = {}
        if analyzer is not None and analyzer.ndim > 2:
            record["maps"], maps = [ANALYZER], {ANALYZER: analyzer.numpy()}
        elif analyzer is not None:
            record[ANALYZER] = analyzer.tolist()
        self.append(sequence, columns, record, maps)

    def analyzer(self, sequence: str) -> Float32[Tensor, "4 3 *pixels"] | None:
        """Weights a0, a1, a2 of each channel's pixels: the light behind one is a0 S0 + a1 S1 + a2 S2.

        Shape (4, 3) if all pixels of a channel are alike, else (4, 3, height, width), as
        `polarnet.simulation.pixel_analyzers` says. None for recordings and for a polarizer that rotates.
        """
        record = self.record(sequence)
        if ANALYZER in record.get("maps", ()):
            return torch.from_numpy(self.read_array(f"{ANALYZER}/{sequence}", sequence))
        return torch.tensor(record[ANALYZER]) if ANALYZER in record else None

    def duration_us(self, sequence: str) -> int:
        """Length of a sequence in microseconds."""
        return self.record(sequence)["duration_us"]

    def count(self, sequence: str) -> tuple[int, ...]:
        """Number of events in each channel of a sequence."""
        return tuple(np.diff(self.record(sequence)["offsets"]).tolist())

    def read(self, sequence: str, start_us: int | None = None, stop_us: int | None = None) -> list[Events]:
        """The four channels of a sequence, whole or limited to events with start <= t < stop.

        Times always count from the start of the sequence. Reads only the chunks that overlap the window. ValueError
        names sequence and column of unreadable data.
        """
        record = self.record(sequence)
        if start_us is None and stop_us is None:
            (events,) = self.rows(sequence, [(0, record["offsets"][-1])])
            channels = [slice_count(events, start, stop) for start, stop in itertools.pairwise(record["offsets"])]
            return self._valid(sequence, channels)
        start_us = max(0, start_us or 0)
        stop_us = MAX_DURATION_US + 1 if stop_us is None else max(start_us, stop_us)
        spans = []
        for (first, end), index in zip(itertools.pairwise(record["offsets"]), record["index"], strict=True):
            before, after = bisect.bisect_left(index, start_us), bisect.bisect_left(index, stop_us)
            spans.append((first + max(0, before - 1) * INDEX_STEP, min(first + after * INDEX_STEP, end)))
        return self._valid(sequence, [slice_time(events, start_us, stop_us) for events in self.rows(sequence, spans)])

    def rows(self, sequence: str, spans: Sequence[tuple[int, int]]) -> list[Events]:
        """The events in each of the spans (start, stop) of a sequence's rows."""
        return [
            Events(
                torch.from_numpy(rows["t"].astype(np.int64)),
                torch.from_numpy(rows["x"].view(np.int16)),
                torch.from_numpy(rows["y"].view(np.int16)),
                torch.from_numpy(rows["p"]),
                self.height,
                self.width,
            )
            for rows in self.read_columns(sequence, COLUMNS, spans)
        ]

    def _valid(self, sequence: str, channels: list[Events]) -> list[Events]:
        """The channels; ValueError for an event off the sensor, which would let a kernel write outside its arrays."""
        try:
            return [*map(validate, channels)]
        except ValueError as error:
            raise ValueError(f"{self.path}: {sequence}: {error}; {REPAIR}") from None

    def check_record(self, sequence: str, record: Header) -> None:
        """ValueError for a record that no writer makes, such as a duration above 71 minutes."""
        super().check_record(sequence, record)
        offsets, (start, stop), duration_us = record["offsets"], record["rows"], record["duration_us"]
        spans = len(offsets) == NUM_CHANNELS + 1 and offsets == sorted([0, *offsets[1:-1], stop - start])
        steps = [-(-int(count) // INDEX_STEP) for count in np.diff(offsets)]
        if not (spans and [*map(len, record["index"])] == steps and 0 < duration_us <= MAX_DURATION_US):
            raise ValueError(
                f"{sequence}: expected offsets of {stop - start} events, got {offsets} in {duration_us} us"
            )

    def _check(self, channels: Sequence[Events], duration_us: int) -> None:
        if len(channels) != NUM_CHANNELS:
            raise ValueError(f"expected a channel for each of {NUM_CHANNELS} polarizers, got {len(channels)}")
        if not 0 < duration_us <= MAX_DURATION_US:
            raise ValueError(f"expected a duration of 1 to {MAX_DURATION_US} us, got {duration_us}; cut the sequence")
        for angle, channel in zip(POLARIZER_ANGLES_DEG, channels, strict=True):
            size = f"{channel.height}x{channel.width}"
            if size != f"{self.height}x{self.width}":
                raise ValueError(f"polarizer {angle}: expected a sensor of {self.height}x{self.width} px, got {size}")
            try:
                validate(channel)
            except ValueError as error:
                raise ValueError(f"polarizer {angle}: {error}") from None
            if len(channel) and not 0 <= (first := int(channel.t[0])) <= (last := int(channel.t[-1])) <= duration_us:
                times = f"times from 0 to the duration of {duration_us} us, got {first} to {last} us"
                raise ValueError(f"polarizer {angle}: expected {times}")
