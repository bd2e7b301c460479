"""Live recovery on a processor that is too slow, simulated by a method that takes its time on a clock of its own."""

import itertools
import threading
import time
from collections import deque

import numpy as np
import pytest
import torch
from event_fixtures import events_of

from polarnet.events.streaming import WindowRule
from polarnet.methods.method import Recoverer
from polarnet.recordings.ahead import Ahead
from polarnet.recordings.arrangements import Piece
from polarnet.recovery.stream import MAX_LATENCY_S, Input, frames_of, recover
from polarnet.recovery.writer import RecoveryWriter
from polarnet.stokes import Prediction

HEIGHT, WIDTH, WINDOW_US, PIECE_US, PIECES = 4, 6, 10_000, 2_000, 750


class Clock:
    """A clock that work and waiting move on."""

    now_s = 0.0

    def perf_counter(self):
        return self.now_s


@pytest.fixture
def clock(monkeypatch):
    """Replaces the clock of `frames_of`."""
    clock = Clock()
    monkeypatch.setattr("polarnet.recovery.stream.time", clock)
    return clock


def source(clock, *, waits, damaged=False):
    """A second and a half of a camera: an event in each channel every 0.1 ms, delivered every 2 ms."""
    ahead = deque()
    for k in range(PIECES):
        channel = events_of([(k * PIECE_US + t_us, 1, 1, 1) for t_us in range(0, PIECE_US, 100)], HEIGHT, WIDTH)
        ahead.append(Piece([channel] * 4, (k + 1) * PIECE_US, (k + 1) * PIECE_US * 1e-6))

    def pieces():
        while ahead:
            clock.now_s = max(clock.now_s, ahead[0].read_at)
            yield ahead.popleft()
        if damaged:
            raise ValueError("damaged")

    def unread():
        return bool(ahead) and ahead[0].read_at <= clock.now_s

    return Input("camera", HEIGHT, WIDTH, pieces(), live=True, waits=waits, unread=unread)


def method(clock, work_s, taken):
    """A method that takes this long for a window, whatever is in it, and notes how many events it was given."""

    def predict(state, windows):
        clock.now_s += work_s * len(windows)
        taken.extend(len(window.channels[0]) for window in windows)
        maps = torch.full((len(windows), HEIGHT, WIDTH), 0.5)
        return state, Prediction(maps, maps)

    return Recoverer(lambda height, width: None, predict, at_once=lambda height, width: 1)


@pytest.mark.thorough
@pytest.mark.parametrize("work_s", [0.012, 0.04, 0.1])
@pytest.mark.parametrize(("step_us", "windows"), [(None, 150), (2_000, 746)])
def test_windows_are_joined_if_the_processor_is_too_slow(clock, tmp_path, monkeypatch, step_us, windows, work_s):
    taken: list[int] = []
    camera, rule = source(clock, waits=False), WindowRule(WINDOW_US, step_us)
    frames = list(frames_of(camera, rule, method(clock, work_s, taken)))
    assert sum(frame.window.joined for frame in frames) == windows
    assert clock.now_s < 1.5 + 0.3  # one by one, they would take up to 15 s
    late_s = [frame.latency_s for frame in frames[2:]]  # two show how long the work takes
    assert np.quantile(late_s, 0.95) <= max(MAX_LATENCY_S, work_s + 0.01)
    for before, after in itertools.pairwise(frames):
        assert after.window.start_us <= before.window.stop_us  # so no event is in none of them
    if step_us is None:
        assert sum(taken) == 15_000
    monkeypatch.undo()
    facts = recover(camera, rule, "method", RecoveryWriter(tmp_path, ("zarr",)), iter(frames))
    joined = [frame.window.joined for frame in frames if frame.window.joined > 1]
    assert facts["joined"].startswith(f"{sum(joined)} windows to {len(joined)} frames: the processor did not keep up")


def test_windows_stay_apart_if_the_processor_keeps_up_or_the_source_waits(clock):
    frames = frames_of(source(clock, waits=False), WindowRule(WINDOW_US, None), method(clock, 0.005, []))
    beginning = list(itertools.islice(frames, 20))
    clock.now_s += 0.3
    rest = list(frames)
    assert [frame.window.joined for frame in (*beginning, *rest)] == [1] * 150
    assert rest[0].latency_s > 0.2
    assert rest[-1].latency_s < 0.01
    frames = list(frames_of(source(clock, waits=True), WindowRule(WINDOW_US, None), method(clock, 0.1, [])))
    assert [frame.window.stop_us for frame in frames] == [*range(WINDOW_US, 1_500_001, WINDOW_US)]


def test_an_error_of_live_input_comes_after_the_frames_before_it(clock):
    frames = frames_of(source(clock, waits=False, damaged=True), WindowRule(WINDOW_US, None), method(clock, 0.1, []))
    joined = []
    with pytest.raises(ValueError, match="damaged"):
        joined.extend(frame.window.joined for frame in frames)
    assert sum(joined) == 150


def test_what_is_read_ahead_comes_in_order_and_an_error_after_what_was_before_it():
    def failing():
        yield from range(5)
        raise ValueError("damaged")

    with Ahead(failing(), 2) as ahead:
        items = iter(ahead)
        assert list(itertools.islice(items, 5)) == [0, 1, 2, 3, 4]
        with pytest.raises(ValueError, match="damaged"):
            next(items)


def test_reading_ahead_ends_with_its_reader_and_is_bounded_in_memory():
    before, taken = threading.active_count(), []
    with Ahead(map(taken.append, itertools.count()), 3) as ahead:
        next(iter(ahead))
        assert threading.active_count() == before + 1
    while threading.active_count() > before:
        time.sleep(0.001)
    assert len(taken) <= 7
    read = []
    ahead = Ahead((read.append(k) or k for k in range(100)), 4)
    while len(read) < 5:  # four in the queue, and the one that waits for room
        time.sleep(0.001)
    assert len(read) == 5
    assert list(ahead) == list(range(100))
