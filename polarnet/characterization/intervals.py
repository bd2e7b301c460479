"""Pairs of consecutive events of a pixel, and the refractory period from the shortest of them.

Between the two events of a pair, the filtered log light changes by one threshold.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from polarnet.events.stream import Events

GROUPS = 8  # groups of pixels, whose differences give standard errors
MAX_RELATIVE_ERROR = 0.5  # an estimate with a larger standard error is discarded
PILE_UP = 3.0  # intervals of 0.9 to 1.1 times the shortest, over those of 1.1 to 1.3 times the shortest
MIN_TICKS = 5  # ticks of the recording's clock in the shortest refractory period that can be measured


class Estimate(NamedTuple):
    """A parameter of the sensor."""

    value: float
    error: float
    """Standard error."""
    source: str  # recordings and events behind the estimate, in words


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
    def duration_us(self) -> Float64[np.ndarray, " m"]:
        """Time from the first event to the second."""
        return self.stop_us - self.start_us

    def chosen(self, which: Bool[np.ndarray, " m"] | slice) -> "Intervals":
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


def undisturbed(intervals: Intervals, refractory_us: float, margin: float = 1.3) -> Intervals:
    """Intervals longer than `margin` times the refractory period, except those right after a shorter one.

    A crossing within the refractory period waits for its end: its increment exceeds one threshold, and the next
    increment lacks the excess.
    """
    free = intervals.duration_us > margin * refractory_us
    after_waiting = np.zeros(len(free), bool)
    after_waiting[1:] = (intervals.pixel[1:] == intervals.pixel[:-1]) & ~free[:-1]
    return intervals.chosen(free & ~after_waiting)


def piled_up_us(durations_us: Sequence[Float64[np.ndarray, " _"]]) -> Estimate | None:
    """Shortest interval, if intervals pile up there: crossings within the refractory period waited for its end."""
    durations = np.concatenate(durations_us) if durations_us else np.empty(0)
    durations = np.sort(durations[durations > 0])
    supported = max(5, int(1e-5 * len(durations)))
    if len(durations) <= supported:
        return None
    shortest = durations[supported]
    if shortest < MIN_TICKS * _tick_us(durations):
        return None  # a coarse clock piles intervals up as well
    edges = np.searchsorted(durations, shortest * np.array([0.9, 1.1, 1.3]))
    piled, next_to = np.diff(edges)
    if piled < 20 or piled < PILE_UP * next_to:
        return None
    near = durations[edges[0] : edges[1]]
    return Estimate(float(np.median(near)), float(near.std()) / math.sqrt(len(near)), "shortest intervals of a pixel")


def _tick_us(durations: Float64[np.ndarray, " _"]) -> float:
    """Step of the recording's clock."""
    return float(np.gcd.reduce(np.rint(durations).astype(np.int64)))
