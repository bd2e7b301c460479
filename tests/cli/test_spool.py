"""Pieces of events that wait on disk come back as one sequence."""

import torch
from event_fixtures import make_events, make_random_events

from polarnet.cli.spool import EventSpool
from polarnet.events.stream import concatenate

__all__ = ["make_events", "make_random_events"]


def test_pieces_come_back_joined_and_a_channel_without_events_is_empty(tmp_path, make_random_events, make_events):
    pieces = [make_random_events(seed, 50, 1000, 8, 12) for seed in (1, 2)]
    later = pieces[1].__class__(pieces[1].t + 1000, pieces[1].x, pieces[1].y, pieces[1].p, 8, 12)
    silent = make_events([], 8, 12)
    with EventSpool(tmp_path / "spool") as spool:
        spool.append([pieces[0], silent])
        spool.append([later, silent])
        first, second = spool.channels()
        expected = concatenate([pieces[0], later])
        assert all(torch.equal(getattr(first, name), getattr(expected, name)) for name in "txyp")
        assert (len(second), second.height, second.width) == (0, 8, 12)
