"""Pairs of consecutive events of a pixel, between which the filtered log light changes by one threshold."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from polarnet.events.stream import Events


class PixelEvents(NamedTuple):
    """Events of one recording ordered by pixel, then time."""

    pixel: Int64[np.ndarray, " n"]
    t_us: Float64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]
    pixels: int
    """Number of pixels of the sensor."""


class Intervals(NamedTuple):
    """Pairs of consecutive events of one pixel. `start` and `stop` index `PixelEvents`."""

    start: Int64[np.ndarray, " m"]
    stop: Int64[np.ndarray, " m"]
    pixel: Int64[np.ndarray, " m"]
    on: Bool[np.ndarray, " m"]
    """Polarity of the event at the end."""
    duration_us: Float64[np.ndarray, " m"]


def by_pixel(events: Events) -> PixelEvents:
    """The events ordered by pixel, then time."""
    pixel = events.y.numpy().astype(np.int64) * events.width + events.x.numpy()
    order = np.argsort(pixel, kind="stable")  # events are in time order already
    return PixelEvents(
        pixel[order],
        events.t.numpy()[order].astype(np.float64),
        events.p.numpy()[order] > 0,
        events.height * events.width,
    )


def chosen_pixels(events: PixelEvents, chosen: Bool[np.ndarray, " pixels"]) -> PixelEvents:
    """The events of some pixels."""
    selected = chosen[events.pixel]
    return PixelEvents(events.pixel[selected], events.t_us[selected], events.on[selected], events.pixels)


def intervals_of(events: PixelEvents) -> Intervals:
    """All pairs of consecutive events of a pixel."""
    start = np.flatnonzero(events.pixel[1:] == events.pixel[:-1])
    stop = start + 1
    return Intervals(start, stop, events.pixel[stop], events.on[stop], events.t_us[stop] - events.t_us[start])


def undisturbed(intervals: Intervals, refractory_us: float, margin: float = 1.3) -> Intervals:
    """Intervals longer than `margin` times the refractory period, except those right after a shorter one.

    A crossing within the refractory period waits for its end: its increment exceeds one threshold, and the next
    increment lacks the excess.
    """
    free = intervals.duration_us > margin * refractory_us
    after_waiting = np.zeros(len(free), bool)
    follows = intervals.start[1:] == intervals.stop[:-1]
    after_waiting[1:] = follows & ~free[:-1]
    usable = free & ~after_waiting
    return Intervals(*(column[usable] for column in intervals))
