"""Summarise a recording: events, rates, duration, hot pixels, gaps, empty rows, an image of the busiest part."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int64

from polarnet.events.stream import Events
from polarnet.recordings.noise import hot_pixels
from polarnet.recordings.recording import FORMATS, RecordingReader
from polarnet.recordings.source import REPAIRS
from polarnet.runtime.compilation import compiled

EVENTS_PER_PIXEL = 0.15  # in the part shown: enough to see edges, few enough not to smear them
WORST_PIXELS = 4  # hot pixels named in the findings


@dataclass
class Inspection:
    """Summary of a recording's content."""

    format: str
    counts: Int64[np.ndarray, "h w"]
    """Events of each pixel."""
    hot: Bool[np.ndarray, "h w"]
    busiest: Events
    """The part that took the least time: consecutive events, 0.15 per pixel, that do not start with the recording."""
    on: int = 0
    """Number of ON events."""
    start_us: int = 0
    stop_us: int = 0
    """Times of the first and the last event; 0 without events."""
    gap_us: int = 0
    """The longest time without events."""
    gap_start_us: int = 0
    repairs: Mapping[str, int] = field(default_factory=dict)

    @property
    def events(self) -> int:
        """Number of events."""
        return int(self.counts.sum())


def inspect_recording(reader: RecordingReader) -> Inspection:
    """Read a recording once, in memory that does not grow with it; RecordingError if reading fails."""
    shape = reader.height, reader.width
    one = Inspection(reader.format, np.zeros(shape, np.int64), np.zeros(shape, np.bool_), Events.empty(*shape))
    size, least = max(1, round(EVENTS_PER_PIXEL * one.counts.size)), (True, np.inf)
    for events in reader.chunks(size):
        first, last = int(events.t[0]), int(events.t[-1])
        if not len(one.busiest):
            one.start_us = one.stop_us = first
        columns = (getattr(events, name).numpy() for name in "txyp")
        brighter, silence_us, silence_end_us = _tally(*columns, one.counts, one.stop_us)
        one.on += brighter
        if silence_us > one.gap_us:
            one.gap_us, one.gap_start_us = silence_us, silence_end_us - silence_us
        one.stop_us = last
        # many pixels fire when a camera or its simulation starts, which is not the scene's motion
        duration = (first == one.start_us or len(events) < size, last - first)
        if duration < least or not len(one.busiest):
            one.busiest, least = events, duration
    one.hot = hot_pixels(one.counts, (one.stop_us - one.start_us) * 1e-6)
    one.repairs = {kind: count for kind, count in reader.repairs.items() if count}
    return one


@compiled
def _tally(t, x, y, p, counts, before):
    """Count the events of each pixel; returns the number of ON events, the longest silence and its end."""
    on, longest, end = 0, 0, before
    for i in range(len(t)):
        counts[y[i], x[i]] += 1
        on += p[i] > 0
        if t[i] - before > longest:
            longest, end = t[i] - before, t[i]
        before = t[i]
    return on, longest, end


def findings(inspection: Inspection) -> Iterator[str]:
    """The summary as lines of text."""
    height, width = inspection.counts.shape
    yield f"format      {inspection.format}: {FORMATS[inspection.format].words}"
    yield f"sensor      {height} x {width} px (height x width)"
    on, off = inspection.on, inspection.events - inspection.on
    yield f"events      {inspection.events:,}: {on:,} ON, {off:,} OFF"
    seconds = (inspection.stop_us - inspection.start_us) / 1e6
    if inspection.events:
        yield f"time        {inspection.start_us:,} to {inspection.stop_us:,} us, {seconds:.6f} s"
    if seconds > 0:
        t, count = inspection.busiest.t, len(inspection.busiest)
        busiest_us = max(1, int(t[-1] - t[0]))
        yield f"rate        {on / seconds / 1000:,.2f} kev/s ON, {off / seconds / 1000:,.2f} kev/s OFF"
        yield (
            f"busiest     {count:,} events in {busiest_us / 1000:,.1f} ms from {int(t[0]):,} us, "
            f"{1000 * count / busiest_us:,.2f} kev/s"
        )
        yield f"gap         at most {inspection.gap_us:,} us without events from {inspection.gap_start_us:,} us"
        if empty := int((inspection.counts.sum(axis=1) == 0).sum()):
            yield f"empty rows  {empty} of {height} without any event"
    yield f"hot pixels  {_hot(inspection)}"
    repairs = dict(inspection.repairs)
    pauses = repairs.pop("pauses", 0)
    yield f"time jumps  {pauses} {REPAIRS['pauses']}" if pauses else "time jumps  none"
    for kind, count in repairs.items():
        yield f"repaired    {count:,} {REPAIRS[kind]}"
    if not repairs:
        yield "repaired    nothing"


def _hot(inspection: Inspection) -> str:
    rows, columns = np.nonzero(inspection.hot)
    if not len(rows):
        return "none"
    counts = inspection.counts[rows, columns]
    order = np.argsort(-counts, kind="stable")[:WORST_PIXELS]
    worst = ", ".join(f"x {columns[i]} y {rows[i]}: {counts[i]:,}" for i in order)
    more = ", ..." if len(rows) > len(order) else ""
    return f"{len(rows)} with {counts.sum() / inspection.events:.1%} of the events ({worst}{more})"
