"""Readout of the simulated sensor, on event lists whose times are worked out by hand."""

import dataclasses

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events, validate
from polarnet.simulation.camera import ReadoutConfig, read_out

PERFECT = ReadoutConfig(row_latency_us=0.0, jitter_us=0.0, max_events_per_s=None, max_wait_us=1000.0, randomise=None)


def events_at(*rows: tuple[int, int, int], height: int = 10, width: int = 10) -> Events:
    """ON events from (time in microseconds, row, column)."""
    t, y, x = (np.array(column) for column in zip(*rows, strict=True))
    return Events.from_columns(t, x, y, np.ones(len(t), np.int8), height, width)


def triples(events: Events) -> list[tuple[int, int, int]]:
    return list(zip(events.t.tolist(), events.y.tolist(), events.x.tolist(), strict=True))


def test_each_row_is_late_by_its_number_times_the_latency():
    events = events_at((10, 5, 0), (11, 0, 1), (20, 2, 2))
    leaving, lost = read_out(events, dataclasses.replace(PERFECT, row_latency_us=2.0), key=1, duration_us=100)
    assert triples(leaving) == [(11, 0, 1), (20, 5, 0), (24, 2, 2)]
    assert lost == 0


def test_a_row_leaves_together_when_the_bus_has_carried_it():
    """A million events a second: two of row 3 leave at 12, and the one of row 4 waits for them and leaves at 13."""
    events = events_at((10, 3, 0), (10, 3, 7), (11, 4, 1))
    config = dataclasses.replace(PERFECT, max_events_per_s=1e6)
    leaving, lost = read_out(events, config, key=1, duration_us=100)
    assert triples(leaving) == [(12, 3, 0), (12, 3, 7), (13, 4, 1)]
    assert lost == 0


def test_a_row_that_would_wait_too_long_is_lost_whole_and_takes_no_time():
    """Ten events of row 0 keep the bus busy from 0 to 100; row 1 would wait 95 of allowed 20, row 2 waits 10."""
    events = events_at(*((0, 0, x) for x in range(10)), (5, 1, 0), (5, 1, 1), (90, 2, 0))
    config = dataclasses.replace(PERFECT, max_events_per_s=1e5, max_wait_us=20.0)
    leaving, lost = read_out(events, config, key=1, duration_us=1000)
    assert lost == 2
    assert triples(leaving)[-1] == (110, 2, 0)
    assert len(leaving) == 11


def test_a_saturated_bus_carries_its_limit():
    generator = np.random.default_rng(0)
    t = np.sort(generator.integers(0, 100_000, 50_000))
    events = events_at(*zip(t, generator.integers(0, 10, 50_000), generator.integers(0, 10, 50_000), strict=True))
    config = dataclasses.replace(PERFECT, max_events_per_s=2e5, max_wait_us=500.0)
    leaving, lost = read_out(events, config, key=1, duration_us=100_000)
    assert len(leaving) == pytest.approx(20_000, rel=0.01)  # 0.1 s of 200,000 a second
    assert len(leaving) + lost == pytest.approx(50_000, abs=110)  # those still waiting when the recording stops


def test_jitter_has_the_stated_deviation_depends_on_the_key_and_keeps_time_order():
    t = np.arange(1000, 21_000)
    events = events_at(*zip(t, t % 10, t // 10 % 10, strict=True))
    config = dataclasses.replace(PERFECT, jitter_us=30.0)
    leaving, _ = read_out(events, config, key=1, duration_us=30_000)
    validate(leaving)
    assert len(leaving) == len(events)
    again, _ = read_out(events, config, key=1, duration_us=30_000)
    other, _ = read_out(events, config, key=2, duration_us=30_000)
    assert torch.equal(leaving.t, again.t)
    assert not torch.equal(leaving.x, other.x)
    single = events_at(*((10_000, y, x) for y in range(100) for x in range(100)), height=100, width=100)
    spread, _ = read_out(single, config, key=1, duration_us=30_000)
    assert float(spread.t.double().std()) == pytest.approx(30, rel=0.03)


def test_events_after_the_end_of_the_recording_are_missing():
    leaving, lost = read_out(
        events_at((10, 0, 0), (95, 9, 0)), dataclasses.replace(PERFECT, row_latency_us=1.0), key=1, duration_us=100
    )
    assert triples(leaving) == [(10, 0, 0)]
    assert lost == 0
