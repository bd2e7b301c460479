"""Summarise a recording: event counts and rates, duration, hot pixels, and an image of its busiest part."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int64, UInt16

from polarnet.events.stream import Events
from polarnet.recordings.formats.celex5_bin import celex5_pictures
from polarnet.recordings.pixels import hot_pixels
from polarnet.recordings.recording import FORMATS, RecordingReader
from polarnet.recordings.source import REPAIRS, RecordingError

MAX_PIXELS = 2**25
MIN_SPAN_US = 1000  # shortest time over which a rate is taken
EVENTS_PER_PIXEL = 0.15  # in the part shown: enough to see edges, few enough not to smear them


@dataclass(frozen=True)
class Inspection:
    """Summary of a recording's content."""

    format: str
    height: int
    width: int
    on: int
    off: int
    start_us: int | None
    """Time of the first event; None without events."""
    stop_us: int | None
    counts: Int64[np.ndarray, "h w"]
    """Events of each pixel."""
    hot: Bool[np.ndarray, "h w"]
    busiest: Int64[np.ndarray, "h w"]
    """Signed counts of the busiest part: the consecutive events, 0.15 per pixel, that took the least time."""
    busiest_rate_hz: float
    """Events per second in the busiest part."""
    repairs: Mapping[str, int]
    pictures: int
    """Number of full pictures between events, or in a file without events."""
    first_picture: UInt16[np.ndarray, "h w"] | None


def inspect_recording(reader: RecordingReader, hot_pixel_factor: float | int) -> Inspection:
    """Read a recording once, in constant memory.

    `hot_pixel_factor` is the `factor` of `polarnet.recordings.pixels.hot_pixels`. RecordingError if reading fails, or
    if no sensor is as large as the stated size.
    """
    pixels = reader.height * reader.width
    if pixels > MAX_PIXELS:
        raise RecordingError(
            f"{reader.path.name}: no event camera has {reader.height} x {reader.width} px (height x width): the "
            f"given size is wrong, or the file is damaged"
        )
    counts = np.zeros(pixels, np.int64)
    busiest = _Busiest(pixels)
    on = off = 0
    start_us = stop_us = None
    for events in reader:
        pixel = events.y.numpy().astype(np.int64) * reader.width + events.x.numpy()
        counts += np.bincount(pixel, minlength=pixels)
        on += int((events.p > 0).sum())
        off += int((events.p < 0).sum())
        start_us = int(events.t[0]) if start_us is None else start_us
        stop_us = int(events.t[-1])
        busiest.add(events, pixel)
    pictures, first_picture = 0, None
    if reader.format == "celex5_bin":
        for picture in celex5_pictures(reader.path):
            first_picture = picture.intensity if pictures == 0 else first_picture
            pictures += 1
    shape = reader.height, reader.width
    signed, rate_hz = busiest.result()
    return Inspection(
        format=reader.format,
        height=reader.height,
        width=reader.width,
        on=on,
        off=off,
        start_us=start_us,
        stop_us=stop_us,
        counts=counts.reshape(shape),
        hot=hot_pixels(counts.reshape(shape), ((stop_us or 0) - (start_us or 0)) * 1e-6, hot_pixel_factor),
        busiest=signed.reshape(shape),
        busiest_rate_hz=rate_hz,
        repairs={kind: count for kind, count in reader.repairs.items() if count},
        pictures=pictures,
        first_picture=first_picture,
    )


def findings(inspection: Inspection) -> Iterator[str]:
    """The summary as lines of text."""
    events = inspection.on + inspection.off
    yield f"format      {inspection.format}: {FORMATS[inspection.format].words}"
    yield f"sensor      {inspection.height} x {inspection.width} px (height x width)"
    if inspection.pictures:
        yield f"pictures    {inspection.pictures}"
    yield f"events      {events:,}: {inspection.on:,} ON, {inspection.off:,} OFF"
    if inspection.start_us is not None and inspection.stop_us is not None:
        seconds = (inspection.stop_us - inspection.start_us) / 1e6
        yield f"time        {inspection.start_us:,} to {inspection.stop_us:,} us, {seconds:.6f} s"
        if seconds > 0:
            yield f"rate        {_rate(inspection.on / seconds)} ON, {_rate(inspection.off / seconds)} OFF; " + (
                f"up to {_rate(inspection.busiest_rate_hz)} together"
            )
    yield f"hot pixels  {_hot(inspection)}"
    pauses = inspection.repairs.get("pauses", 0)
    yield f"time jumps  {pauses} {REPAIRS['pauses']}" if pauses else "time jumps  none"
    repairs = {kind: count for kind, count in inspection.repairs.items() if kind != "pauses"}
    for kind, count in repairs.items():
        yield f"repaired    {count:,} {REPAIRS[kind]}"
    if not repairs:
        yield "repaired    nothing"


def _rate(rate_hz: float) -> str:
    for unit, name in ((1e6, "M"), (1e3, "k")):
        if rate_hz >= unit:
            return f"{rate_hz / unit:.2f} {name}ev/s"
    return f"{rate_hz:.1f} ev/s"


def _hot(inspection: Inspection) -> str:
    rows, columns = np.nonzero(inspection.hot)
    if not len(rows):
        return "none"
    counts = inspection.counts[rows, columns]
    order = np.argsort(-counts, kind="stable")[:4]
    share = counts.sum() / max(1, inspection.counts.sum())
    worst = ", ".join(f"x {columns[i]} y {rows[i]}: {counts[i]:,}" for i in order)
    return f"{len(rows)} with {share:.1%} of the events ({worst}{', ...' if len(rows) > len(order) else ''})"


class _Busiest:
    """Finds the busiest of the consecutive parts of a recording, each with the same number of events."""

    def __init__(self, pixels: int):
        self._size = max(1, round(EVENTS_PER_PIXEL * pixels))
        self._image = np.zeros(pixels, np.int64)
        self._count, self._start_us, self._stop_us = 0, 0, 0
        self._best: np.ndarray | None = None
        self._best_us = 0

    def add(self, events: Events, pixel: Int64[np.ndarray, " n"]) -> None:
        start = 0
        while start < len(events):
            stop = min(len(events), start + self._size - self._count)
            if self._count == 0:
                self._start_us = int(events.t[start])
            signs = events.p[start:stop].numpy().astype(np.float64)
            self._image += np.bincount(pixel[start:stop], signs, len(self._image)).astype(np.int64)
            self._count += stop - start
            self._stop_us = int(events.t[stop - 1])
            start = stop
            if self._count == self._size:
                took_us = self._stop_us - self._start_us
                if self._best is None or took_us < self._best_us:
                    self._best, self._best_us = self._image.copy(), took_us
                self._image[:] = 0
                self._count = 0

    def result(self) -> tuple[np.ndarray, float]:
        """The signed image and the events per second; both cover all events if there were too few for one part."""
        if self._best is not None:
            return self._best, self._size / max(MIN_SPAN_US, self._best_us) * 1e6
        return self._image, self._count / max(MIN_SPAN_US, self._stop_us - self._start_us) * 1e6
