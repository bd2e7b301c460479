"""Summarise a recording: events, rates, duration, hot pixels, gaps, empty rows, an image of the busiest part."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64, UInt16

from polarnet.events.stream import Events, concatenate, slice_count
from polarnet.recordings.formats.celex5_bin import celex5_pictures
from polarnet.recordings.pixels import hot_pixels
from polarnet.recordings.readout import Gap, Silences, readout_findings
from polarnet.recordings.recording import FORMATS, RecordingReader
from polarnet.recordings.source import REPAIRS

EVENTS_PER_PIXEL = 0.15  # in the part shown: enough to see edges, few enough not to smear them
PEAK_US = (1_000, 10_000, 100_000)  # intervals of the peak rate; the first that holds MIN_STEPS of the clock is taken
MIN_STEPS = 10
START_SHARE = 0.5  # of all pixels: more events at the first time mean that a camera or a simulator started
WORST_PIXELS = 4  # hot pixels named in the findings


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
    busiest_events: int
    busiest_start_us: int
    busiest_us: int
    """Number of events, first time and duration of the busiest part."""
    peak_rate_hz: float | None
    """Events per second in the busiest interval of `peak_us`; None for a recording that is shorter."""
    peak_us: int
    start_events: int
    """Events at the first time if more than half the pixels fired then, else 0; left out of peak and busiest part."""
    gap: Gap | None
    """The longest time without events; None if all events have the same time."""
    repairs: Mapping[str, int]
    pictures: int
    """Number of full pictures between events, or in a file without events."""
    first_picture: UInt16[np.ndarray, "h w"] | None


def inspect_recording(reader: RecordingReader, hot_pixel_factor: float | int) -> Inspection:
    """Read a recording once, in memory that does not grow with it unless millions of events have the same time.

    `hot_pixel_factor` is the `factor` of `polarnet.recordings.pixels.hot_pixels`. RecordingError if reading fails.
    """
    shape, pixels = (reader.height, reader.width), reader.height * reader.width
    counts = np.zeros(pixels, np.int64)
    busiest, peak, silences = _Busiest(pixels), _Peak(), Silences()
    on = off = start_events = 0
    start_us = stop_us = None
    for events in _whole_times(reader):
        pixel = events.y.numpy().astype(np.int64) * reader.width + events.x.numpy()
        counts += np.bincount(pixel, minlength=pixels)
        rising = int((events.p > 0).sum())
        on, off = on + rising, off + len(events) - rising
        stop_us = int(events.t[-1])
        if start_us is None:
            start_us = int(events.t[0])
            at_first = int((events.t == start_us).sum())
            start_events = at_first if at_first > START_SHARE * pixels else 0
            events, pixel = slice_count(events, start_events, len(events)), pixel[start_events:]
        if len(events):
            busiest.add(events, pixel)
            peak.add(events.t.numpy())
            silences.add(events.t.numpy())
    pictures, first_picture = 0, None
    if reader.format == "celex5_bin":
        for picture in celex5_pictures(reader.path):
            first_picture = picture.intensity if pictures == 0 else first_picture
            pictures += 1
    part = busiest.result()
    peak_us = next((us for us in PEAK_US if us >= MIN_STEPS * silences.clock_step_us), PEAK_US[-1])
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
        busiest=part.image.reshape(shape),
        busiest_events=part.events,
        busiest_start_us=part.start_us,
        busiest_us=part.duration_us,
        peak_rate_hz=peak.rate_hz(peak_us),
        peak_us=peak_us,
        start_events=start_events,
        gap=silences.gap(),
        repairs={kind: count for kind, count in reader.repairs.items() if count},
        pictures=pictures,
        first_picture=first_picture,
    )


def findings(inspection: Inspection) -> Iterator[str]:
    """The summary as lines of text."""
    yield f"format      {inspection.format}: {FORMATS[inspection.format].words}"
    yield f"sensor      {inspection.height} x {inspection.width} px (height x width)"
    if inspection.pictures:
        yield f"pictures    {inspection.pictures}"
    yield f"events      {inspection.on + inspection.off:,}: {inspection.on:,} ON, {inspection.off:,} OFF"
    if inspection.start_us is not None and inspection.stop_us is not None:
        yield from _timing(inspection, inspection.start_us, inspection.stop_us)
        yield from readout_findings(inspection.gap, inspection.counts)
    yield f"hot pixels  {_hot(inspection)}"
    repairs = dict(inspection.repairs)
    pauses = repairs.pop("pauses", 0)
    yield f"time jumps  {pauses} {REPAIRS['pauses']}" if pauses else "time jumps  none"
    for kind, count in repairs.items():
        yield f"repaired    {count:,} {REPAIRS[kind]}"
    if not repairs:
        yield "repaired    nothing"


def _timing(inspection: Inspection, start_us: int, stop_us: int) -> Iterator[str]:
    """Lines about the duration, the rates, the start and the busiest part."""
    seconds = (stop_us - start_us) / 1e6
    yield f"time        {start_us:,} to {stop_us:,} us, {seconds:.6f} s"
    if seconds > 0:
        peak_hz = inspection.peak_rate_hz
        peak = f"; at most {_rate(peak_hz)} together over {inspection.peak_us // 1000} ms" if peak_hz else ""
        yield f"rate        {_rate(inspection.on / seconds)} ON, {_rate(inspection.off / seconds)} OFF{peak}"
    if inspection.start_events:
        yield (
            f"start       {inspection.start_events:,} events at the first time, when the camera or its simulation "
            f"started: not in the peak and the picture"
        )
    yield (
        f"busiest     {inspection.busiest_events:,} events in {inspection.busiest_us / 1000:,.1f} ms from "
        f"{inspection.busiest_start_us:,} us"
    )


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
    order = np.argsort(-counts, kind="stable")[:WORST_PIXELS]
    share = counts.sum() / max(1, inspection.counts.sum())
    worst = ", ".join(f"x {columns[i]} y {rows[i]}: {counts[i]:,}" for i in order)
    return f"{len(rows)} with {share:.1%} of the events ({worst}{', ...' if len(rows) > len(order) else ''})"


def _whole_times(reader: RecordingReader) -> Iterator[Events]:
    """The reader's chunks, cut so that all events of one time are in the same chunk."""
    waiting: list[Events] = []
    for events in reader:
        complete = int((events.t < events.t[-1]).sum())
        if complete:
            yield concatenate([*waiting, slice_count(events, 0, complete)])
            waiting = []
        waiting.append(slice_count(events, complete, len(events)))
    if waiting:
        yield concatenate(waiting)


class _Peak:
    """Finds the highest number of events in successive intervals of `PEAK_US`, from the first event on."""

    def __init__(self) -> None:
        self._start_us: int | None = None
        self._current = dict.fromkeys(PEAK_US, (0, 0))  # number of the interval and its events so far
        self._highest: dict[int, int | None] = dict.fromkeys(PEAK_US)

    def add(self, t: Int64[np.ndarray, " n"]) -> None:
        self._start_us = int(t[0]) if self._start_us is None else self._start_us
        for us in PEAK_US:
            numbers = (t - self._start_us) // us
            first = np.flatnonzero(np.r_[True, numbers[1:] != numbers[:-1]])
            counts = np.diff(np.r_[first, len(t)])
            number, count = self._current[us]
            if numbers[0] == number:
                counts[0] += count
            else:
                self._complete(us, count)
            if len(counts) > 1:
                self._complete(us, int(counts[:-1].max()))
            self._current[us] = int(numbers[-1]), int(counts[-1])

    def _complete(self, us: int, count: int) -> None:
        self._highest[us] = max(count, self._highest[us] or 0)

    def rate_hz(self, us: int) -> float | None:
        """Events per second in the busiest complete interval; None if there is none."""
        highest = self._highest[us]
        return None if highest is None else highest / us * 1e6


class _Part(NamedTuple):
    """Consecutive events of a recording."""

    image: Int64[np.ndarray, " pixels"]
    """Signed counts."""
    events: int
    start_us: int
    duration_us: int

    @property
    def density(self) -> float:
        """Events per microsecond."""
        return self.events / max(1, self.duration_us)


class _Busiest:
    """Finds the busiest part of a recording, cut into parts of 0.15 events per pixel that split no time stamp."""

    def __init__(self, pixels: int):
        self._size = max(1, round(EVENTS_PER_PIXEL * pixels))
        self._current = _Part(np.zeros(pixels, np.int64), 0, 0, 0)
        self._best: _Part | None = None

    def add(self, events: Events, pixel: Int64[np.ndarray, " n"]) -> None:
        t, signs = events.t.numpy(), events.p.numpy().astype(np.float64)
        ends = np.r_[np.flatnonzero(t[1:] != t[:-1]) + 1, len(t)]
        start = 0
        while start < len(t):
            image, count, start_us, _ = self._current
            full = np.searchsorted(ends, start + self._size - count)
            stop = int(ends[min(full, len(ends) - 1)])
            start_us = start_us if count else int(t[start])
            image = image + np.bincount(pixel[start:stop], signs[start:stop], len(image)).astype(np.int64)
            self._current = _Part(image, count + stop - start, start_us, int(t[stop - 1]) - start_us)
            start = stop
            if self._current.events >= self._size:
                if self._best is None or self._current.density > self._best.density:
                    self._best = self._current
                self._current = _Part(np.zeros_like(image), 0, 0, 0)

    def result(self) -> _Part:
        """The busiest part, or all events if they are too few for one."""
        return self._best or self._current
