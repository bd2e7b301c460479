"""The events of one channel as columns, operations on them, and the channels of a 2x2 mosaic of polarizers (DoFP)."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int8, Int16, Int64, Integer
from torch import Tensor

from polarnet.runtime.arrays import Array, whole_numbers
from polarnet.runtime.compilation import compiled
from polarnet.stokes import Mosaic

MAX_SIDE = 2**15 - 1  # pixels; coordinates are int16

Column = Integer[Array, " n"]
_COLUMNS = {"t": torch.int64, "x": torch.int16, "y": torch.int16, "p": torch.int8}


@dataclass(frozen=True)
class Events:
    """Events of one channel, in time order.

    The constructor checks only shapes and types, so that slices are cheap; `validate` checks every event.

    >>> import numpy as np
    >>> from polarnet.events import Events
    >>> one = np.array([1])
    >>> Events.from_columns(t=1000 * one, x=one, y=one, p=-one, height=120, width=180).t
    tensor([1000])
    """

    t: Int64[Tensor, " n"]  # microseconds
    x: Int16[Tensor, " n"]  # column
    y: Int16[Tensor, " n"]  # row
    p: Int8[Tensor, " n"]  # +1 brighter, -1 darker; never 0, so sums need no conversion
    height: int
    width: int

    def __post_init__(self):
        for name, dtype in _COLUMNS.items():
            column = getattr(self, name)
            if column.dtype != dtype or column.shape != self.t.shape or column.ndim != 1:
                raise ValueError(
                    f"events: expected {name} as {dtype} of shape ({len(self.t)},), "
                    f"got {column.dtype} of shape {tuple(column.shape)}"
                )
        if not (0 < self.height <= MAX_SIDE and 0 < self.width <= MAX_SIDE):
            raise ValueError(f"events: expected sides of 1 to {MAX_SIDE} px, got {self.height}x{self.width}")

    def __len__(self) -> int:
        return len(self.t)

    @classmethod
    def from_columns(cls, t: Column, x: Column, y: Column, p: Column, height: int, width: int) -> "Events":
        """Events from numpy or torch columns of any integer type: microseconds, column, row, and +1 or -1.

        TypeError for anything but an array; ValueError for floats, columns of different lengths, and events that
        `validate` refuses.
        """
        columns = {}
        for (name, dtype), values in zip(_COLUMNS.items(), (t, x, y, p), strict=True):
            wide = whole_numbers(name, values)
            columns[name] = wide.to(dtype)
            if not torch.equal(columns[name].long(), wide):
                raise ValueError(f"events: expected {name} that fit {dtype}, got {wide.min()} to {wide.max()}")
        return validate(cls(**columns, height=height, width=width))

    @classmethod
    def empty(cls, height: int, width: int) -> "Events":
        """An empty set of events on a sensor of this size."""
        t, x, y, p = (torch.empty(0, dtype=dtype) for dtype in _COLUMNS.values())
        return cls(t, x, y, p, height, width)


def validate(events: Events) -> Events:
    """`events` if all are in time order, on the sensor and of polarity +1 or -1; else ValueError naming the first."""
    if _all_valid(*(getattr(events, name).numpy() for name in _COLUMNS), events.height, events.width):
        return events
    in_time_order = torch.ones(len(events), dtype=torch.bool)
    in_time_order[1:] = events.t[1:] >= events.t[:-1]
    for holds, expected in (
        (in_time_order, "a time no earlier than that of the event before"),
        ((events.x >= 0) & (events.x < events.width), f"x from 0 to {events.width - 1}"),
        ((events.y >= 0) & (events.y < events.height), f"y from 0 to {events.height - 1}"),
        (events.p.abs() == 1, "polarity +1 or -1"),
    ):
        if not holds.all():
            i = int(holds.logical_not().nonzero()[0])
            values = ", ".join(f"{name}={int(getattr(events, name)[i])}" for name in _COLUMNS)
            raise ValueError(f"event {i} of {len(events)}: expected {expected}, got {values}")
    return events


@compiled
def _all_valid(t, x, y, p, height, width) -> bool:
    """The check of `validate` in one pass, without a branch per event."""
    wrong, before = False, t[0] if t.size else 0
    for i in range(t.size):
        wrong |= (t[i] < before) | (x[i] < 0) | (x[i] >= width) | (y[i] < 0) | (y[i] >= height)
        wrong |= (p[i] != 1) & (p[i] != -1)
        before = t[i]
    return not wrong


def slice_time(events: Events, start_us: int, stop_us: int) -> Events:
    """Events with start <= t < stop."""
    start, stop = torch.searchsorted(events.t, events.t.new_tensor([start_us, stop_us])).tolist()
    return slice_count(events, start, stop)


def slice_count(events: Events, start: int, stop: int) -> Events:
    """Events `start` to `stop` (exclusive) by index; views, not copies."""
    return select(events, slice(start, stop))


def select(events: Events, which: slice | Bool[Tensor, " n"] | Int64[Tensor, " m"]) -> Events:
    """Events chosen by a slice, a mask, or indices in any order."""
    t, x, y, p = (getattr(events, name)[which] for name in _COLUMNS)
    return Events(t, x, y, p, events.height, events.width)


def shifted(events: Events, origin_us: int) -> Events:
    """The same events, with `origin_us` as time 0."""
    return replace(events, t=events.t - origin_us)


def crop(events: Events, top: int, left: int, height: int, width: int) -> Events:
    """Events in a part of the sensor, in coordinates from the part's corner; ValueError if it exceeds the sensor."""
    if not (0 <= top <= top + height <= events.height and 0 <= left <= left + width <= events.width):
        part = f"rows {top} to {top + height} and columns {left} to {left + width}"
        raise ValueError(f"crop: {part} are not on a sensor of {events.height}x{events.width} px")
    inside = (events.y >= top) & (events.y < top + height) & (events.x >= left) & (events.x < left + width)
    cut = select(events, inside)
    return replace(cut, x=cut.x - left, y=cut.y - top, height=height, width=width)


def downscale(events: Events, height: int, width: int) -> Events:
    """The events as a sensor of fewer pixels sees them: pixel (y, x) falls into (y * height // H, x * width // W).

    A coarse pixel keeps the threshold and the rate of a fine one: it fires each time the polarity sum of its fine
    pixels moves by their mean number, H W / (height width). ValueError for a larger size.
    """
    if not (0 < height <= events.height and 0 < width <= events.width):
        raise ValueError(f"downscale: expected a size within {events.height}x{events.width} px, got {height}x{width}")
    y = (events.y.long() * height // events.height).short()
    x = (events.x.long() * width // events.width).short()
    fine_pixels = events.height * events.width / (height * width)
    sums = np.zeros((height, width))
    fired = torch.from_numpy(_fires(y.numpy(), x.numpy(), events.p.numpy(), sums, fine_pixels))
    return select(replace(events, x=x, y=y, height=height, width=width), fired)


def concatenate(parts: Sequence[Events]) -> Events:
    """Join consecutive pieces of one stream; ValueError if a piece starts before the previous one ended."""
    filled = [part for part in parts if len(part)]
    for i, (before, after) in enumerate(itertools.pairwise(filled), start=1):
        if after.t[0] < before.t[-1]:
            times = f"piece {i} starts at {after.t[0]} us, before the end of the piece ahead of it at {before.t[-1]} us"
            raise ValueError(f"concatenate: {times}; merge() sorts streams that overlap")
    return _joined(parts)


def merge(streams: Sequence[Events]) -> Events:
    """Merge streams of one sensor; at equal times, the earlier stream's events come first."""
    joined = _joined(streams)
    return select(joined, torch.sort(joined.t, stable=True).indices)


def _joined(streams: Sequence[Events]) -> Events:
    """The events of one stream after the other."""
    sizes = {(stream.height, stream.width) for stream in streams}
    if len(sizes) != 1:
        raise ValueError(f"expected streams of one sensor, got sizes {sorted(sizes)} (height, width)")
    t, x, y, p = (torch.cat([getattr(stream, name) for stream in streams]) for name in _COLUMNS)
    return Events(t, x, y, p, *sizes.pop())


def places_of(mosaic: Mosaic) -> list[tuple[int, int]]:
    """(row, column) in a 2x2 cell of the pixels at 0, 45, 90 and 135 degrees."""
    return [divmod(int(cell), 2) for cell in np.argsort(np.ravel(mosaic))]


def split_mosaic(events: Events, mosaic: Mosaic) -> list[Events]:
    """The four channels, in the order 0, 45, 90, 135 degrees, of a sensor with polarizers on its pixels.

    Each channel has half of the sensor's rows and columns: its pixel for a 2x2 cell fires when that angle's pixel in
    the cell does. Events of an odd last row or column are left out. ValueError for a sensor without a whole cell.
    """
    height, width = events.height // 2, events.width // 2
    if not (height and width):
        raise ValueError(f"expected a mosaic of at least 2x2 pixels, got {events.height}x{events.width}")
    complete = (events.y < 2 * height) & (events.x < 2 * width)
    channels = []
    for row, column in places_of(mosaic):
        own = select(events, complete & (events.y & 1 == row) & (events.x & 1 == column))
        channels.append(replace(own, x=own.x // 2, y=own.y // 2, height=height, width=width))
    return channels


def join_mosaic(channels: Sequence[Events], mosaic: Mosaic) -> Events:
    """The inverse of `split_mosaic`; events of one time come row by row."""
    placed = [
        replace(e, y=2 * e.y + row, x=2 * e.x + column, height=2 * e.height, width=2 * e.width)
        for e, (row, column) in zip(channels, places_of(mosaic), strict=True)
    ]
    sensor = merge(placed)
    order = np.lexsort([column.numpy() for column in (sensor.p, sensor.x, sensor.y, sensor.t)])
    return select(sensor, torch.from_numpy(order))


@compiled
def _fires(y, x, p, sums, threshold):
    """Mask of the events at which a coarse pixel fires, each time that its polarity sum has moved by `threshold`."""
    fired = np.zeros(len(p), dtype=np.bool_)
    for i in range(len(p)):
        sums[y[i], x[i]] += p[i]
        if sums[y[i], x[i]] * p[i] >= threshold:
            sums[y[i], x[i]] -= p[i] * threshold
            fired[i] = True
    return fired
