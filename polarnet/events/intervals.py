"""Intervals between consecutive events of a pixel, over which the log light changes by one contrast threshold."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from polarnet.events.stream import Events


class PixelEvents(NamedTuple):
    """Events of one recording ordered by pixel, then time."""

    pixel: Int64[np.ndarray, " n"]
    t_us: Float64[np.ndarray, " n"]
    on: Bool[np.ndarray, " n"]
    pixels: int
    """Number of pixels of the sensor."""


class Intervals(NamedTuple):
    """Pairs of consecutive events of one pixel, pixel by pixel."""

    pixel: Int64[np.ndarray, " m"]
    on: Bool[np.ndarray, " m"]
    """Polarity of the event at the end."""
    start_us: Float64[np.ndarray, " m"]
    stop_us: Float64[np.ndarray, " m"]

    @property
    def polarity(self) -> Int8[np.ndarray, " m"]:
        """+1 or -1, of the event at the end."""
        return np.where(self.on, np.int8(1), np.int8(-1))

    @property
    def duration_us(self) -> Float64[np.ndarray, " m"]:
        """Time from the first event to the second."""
        return self.stop_us - self.start_us

    def chosen(self, which: Bool[np.ndarray, " m"] | Int64[np.ndarray, " k"] | slice) -> "Intervals":
        """Some of the intervals."""
        return Intervals(*(column[which] for column in self))


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
    same = events.pixel[1:] == events.pixel[:-1]
    return Intervals(events.pixel[1:][same], events.on[1:][same], events.t_us[:-1][same], events.t_us[1:][same])
