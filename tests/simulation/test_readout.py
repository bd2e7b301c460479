"""Readout of the simulated sensor, on event lists whose times are worked out by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events, validate
from polarnet.simulation.camera import ReadoutConfig, read_out

PERFECT = ReadoutConfig(row_latency_us=0.0, jitter_us=0.0, max_events_per_s=None, max_wait_us=1000.0)


def events_at(*rows: tuple[int, int, int], height: int = 10, width: int = 10) -> Events:
    """ON events from (time in microseconds, row, column)."""
    t, y, x = (np.array(column) for column in zip(*rows, strict=True))
    return Events.from_columns(t, x, y, np.ones(len(t), np.int8), height, width)


def triples(events: Events) -> list[tuple[int, int, int]]:
    return list(zip(events.t.tolist(), events.y.tolist(), events.x.tolist(), strict=True))


@pytest.mark.parametrize(
    ("changes", "rows", "expected"),
    [
        # each row is late by its number times the latency; events that leave after the end at 1000 are missing
        ({"row_latency_us": 2.0}, [(10, 5, 0), (11, 0, 1), (20, 2, 2)], [(11, 0, 1), (20, 5, 0), (24, 2, 2)]),
        ({"row_latency_us": 1.0}, [(10, 0, 0), (995, 9, 0)], [(10, 0, 0)]),
        # a row leaves when the bus has carried all of it: at 12, and the one of row 4 waits for it and leaves at 13
        ({"max_events_per_s": 1e6}, [(10, 3, 0), (10, 3, 7), (11, 4, 1)], [(12, 3, 0), (12, 3, 7), (13, 4, 1)]),
        # ten events of row 0 need the bus to 100: row 1 would wait 95 of allowed 20 and is lost whole, row 2 waits 10
        ({"max_events_per_s": 1e5, "max_wait_us": 20.0},
         [*((0, 0, x) for x in range(10)), (5, 1, 0), (5, 1, 1), (90, 2, 0)],
         [*((100, 0, x) for x in range(10)), (110, 2, 0)]),
    ],
)  # fmt: skip
def test_rows_leave_one_after_another_as_the_bus_carries_them(changes, rows, expected):
    leaving = read_out(events_at(*rows), dataclasses.replace(PERFECT, **changes), key=1, duration_us=1000)
    assert triples(leaving) == expected


def test_jitter_has_the_stated_deviation_depends_on_the_key_and_keeps_time_order():
    t = np.arange(1000, 21_000)
    events = events_at(*zip(t, t % 10, t // 10 % 10, strict=True))
    config = dataclasses.replace(PERFECT, jitter_us=30.0)
    leaving = read_out(events, config, key=1, duration_us=30_000)
    validate(leaving)
    assert len(leaving) == len(events)
    again = read_out(events, config, key=1, duration_us=30_000)
    other = read_out(events, config, key=2, duration_us=30_000)
    assert torch.equal(leaving.t, again.t)
    assert not torch.equal(leaving.x, other.x)
    single = events_at(*((10_000, y, x) for y in range(100) for x in range(100)), height=100, width=100)
    spread = read_out(single, config, key=1, duration_us=30_000)
    assert float(spread.t.double().std()) == pytest.approx(30, rel=0.03)
