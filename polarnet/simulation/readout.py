"""Readout of the simulated sensor: latency by row, timestamp jitter, and a bus that saturates.

A pixel's event waits for its row. All events of a row at one time leave together, one row after another, and the bus
carries a limited number of events a second. An event gets its time when it leaves. Rows that wait for too long are
lost, as in sensors whose event rate exceeds what their readout carries.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from pydantic import NonNegativeFloat, PositiveFloat

from polarnet.events.stream import Events, select
from polarnet.runtime.sections import section
from polarnet.simulation.compilation import compiled, forget_stale_code
from polarnet.simulation.pixels import randomness
from polarnet.simulation.ranges import RandomisedConfig


@section
class ReadoutConfig(RandomisedConfig):
    """Section `readout` of params.yaml: how events leave the sensor."""

    row_latency_us: NonNegativeFloat
    """Delay of each row behind the row above it."""
    jitter_us: NonNegativeFloat
    """Standard deviation of an event's time."""
    max_events_per_s: PositiveFloat | None
    """Events that the bus of a sensor carries per second; null: no limit."""
    max_wait_us: NonNegativeFloat
    """Longest time that a row waits for the bus; a row that would wait longer is lost."""

    @property
    def perfect(self) -> bool:
        """Whether every event leaves at once, with its own time."""
        return not (self.row_latency_us or self.jitter_us or self.max_events_per_s)


PERFECT = ReadoutConfig(row_latency_us=0.0, jitter_us=0.0, max_events_per_s=None, max_wait_us=0.0, randomise=None)


def read_out(events: Events, config: ReadoutConfig, key: int, duration_us: int) -> tuple[Events, int]:
    """The events of one sensor as they leave it, in time order, and the number of events lost on the bus.

    `key` (64 bits) seeds the jitter. Events that would leave after `duration_us` are missing, as in a recording that
    stops there.
    """
    if config.perfect or len(events) == 0:
        return events, 0
    forget_stale_code()
    t, y = events.t.numpy(), events.y.numpy()
    times_us = t + config.row_latency_us * y
    if config.jitter_us:
        jitter = randomness.normal_map(np.uint64(key), randomness.TIMESTAMP, 0, len(t))
        times_us = times_us + config.jitter_us * jitter.astype(np.float64)
    order = np.lexsort((y, t, np.rint(times_us))) if config.jitter_us or config.row_latency_us else np.arange(len(t))
    times_us, rows = np.maximum(times_us[order], 0), y[order].astype(np.int64)
    carried = np.ones(len(order), bool)
    if config.max_events_per_s:
        times_us, carried = _bus(times_us, rows, 1e6 / config.max_events_per_s, config.max_wait_us)
    stamps = np.rint(times_us).astype(np.int64)
    here = torch.from_numpy(order[carried & (stamps <= duration_us)])
    left = torch.from_numpy(stamps[carried & (stamps <= duration_us)])
    return replace(select(events, here), t=left), int((~carried).sum())


@compiled
def _bus(
    times_us: Float64[np.ndarray, " n"], rows: Int64[np.ndarray, " n"], event_us: float, max_wait_us: float
) -> tuple[Float64[np.ndarray, " n"], np.ndarray]:
    """Time at which each event leaves the bus, which takes `event_us` per event, and whether the bus carries it."""
    leaves_us, carried = np.empty(times_us.size), np.zeros(times_us.size, np.bool_)
    free_us, first = -np.inf, 0
    while first < times_us.size:
        stop = first + 1
        while stop < times_us.size and rows[stop] == rows[first] and times_us[stop] - times_us[first] < 1:
            stop += 1
        start_us = max(free_us, times_us[first])
        row_carried = start_us - times_us[first] <= max_wait_us
        if row_carried:
            free_us = start_us + event_us * (stop - first)
        for i in range(first, stop):
            carried[i] = row_carried
            leaves_us[i] = free_us if row_carried else times_us[i]
        first = stop
    return leaves_us, carried
