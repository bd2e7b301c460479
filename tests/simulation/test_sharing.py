"""Planes that threads share piece by piece."""

import numpy as np
import pytest

from polarnet.simulation.pixels.columns import Columns, empty_columns, with_room
from polarnet.simulation.sharing import PIECES, PlaneRun, run_planes


def one_event_a_step(times, log, name):
    """A plane with an event of its own at every time but the first."""

    def advance(first, last, columns):
        log.append((name, first, last))
        columns = with_room(columns, 0, last - first)
        columns.t[: last - first] = times[first + 1 : last + 1].astype(np.int64)
        for column in (columns.x, columns.y, columns.p):
            column[: last - first] = 1
        return columns, last - first

    return advance


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("room", [1, 5, 1000])
def test_each_plane_has_all_its_events_in_order_whatever_the_threads_and_the_room(threads, room):
    times, log = np.arange(101) * 10.0, []
    planes = [PlaneRun(one_event_a_step(times, log, k), empty_columns(room, False, False)) for k in range(4)]
    run_planes(planes, times, threads)
    for plane in planes:
        assert plane.events.t.tolist() == list(range(10, 1010, 10))
        assert all(len(column) == 100 and (column == 1).all() for column in plane.events[1:4])
    assert len(log) == (4 if threads == 1 else 4 * PIECES)


def test_pieces_meet_at_whole_microseconds_only():
    times, log = np.arange(33) * 10.0, []
    times[5:] += 0.5
    planes = [PlaneRun(one_event_a_step(times, log, k), empty_columns(40, False, False)) for k in range(2)]
    run_planes(planes, times, 2)
    assert sorted(log) == [(name, *piece) for name in range(2) for piece in ((0, 4), (4, 32))]


def test_what_goes_wrong_in_a_piece_is_raised():
    def advance(first, last, columns: Columns):
        if first > 0:
            raise RuntimeError("not this one")
        return columns, 0

    planes = [PlaneRun(advance, empty_columns(1, False, False)) for _ in range(3)]
    with pytest.raises(RuntimeError, match="not this one"):
        run_planes(planes, np.arange(50) * 1.0, 2)
