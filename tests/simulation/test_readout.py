"""Readout of the simulated sensor, on event lists whose times are worked out by hand."""

import numpy as np
import pytest

from polarnet.events.stream import Events
from polarnet.simulation.camera import ReadoutConfig, read_out


def events_at(*rows: tuple[int, int, int], height: int = 10, width: int = 10) -> Events:
    """ON events from (time in microseconds, row, column)."""
    t, y, x = (np.array(column) for column in zip(*rows, strict=True))
    return Events.from_columns(t, x, y, np.ones(len(t), np.int8), height, width)


def triples(events: Events) -> list[tuple[int, int, int]]:
    return list(zip(events.t.tolist(), events.y.tolist(), events.x.tolist(), strict=True))


@pytest.mark.parametrize(
    ("max_events_per_s", "max_wait_us", "rows", "expected"),
    [
        # a row leaves when the bus has carried all of it: at 12, and the one of row 4 waits for it and leaves at 13
        (1e6, 1000.0, [(10, 3, 0), (10, 3, 7), (11, 4, 1)], [(12, 3, 0), (12, 3, 7), (13, 4, 1)]),
        # events that leave after the end at 1000 are missing
        (1e6, 1000.0, [(999, 0, 0), (999, 1, 0)], [(1000, 0, 0)]),
        # ten events of row 0 need the bus to 100: row 1 would wait 95 of allowed 20 and is lost whole, row 2 waits 10
        (1e5, 20.0,
         [*((0, 0, x) for x in range(10)), (5, 1, 0), (5, 1, 1), (90, 2, 0)],
         [*((100, 0, x) for x in range(10)), (110, 2, 0)]),
    ],
)  # fmt: skip
def test_rows_leave_one_after_another_as_the_bus_carries_them(max_events_per_s, max_wait_us, rows, expected):
    leaving = read_out(events_at(*rows), ReadoutConfig(max_events_per_s, max_wait_us), duration_us=1000)
    assert triples(leaving) == expected
