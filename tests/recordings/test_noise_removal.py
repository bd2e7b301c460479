"""Removal of hot pixels and of background activity."""

import itertools

import numpy as np
import pytest
import torch

from polarnet.events.stream import merge, select, slice_time
from polarnet.recordings.live import Piece
from polarnet.recordings.noise import Cleaner, Cleaning, read_hot_pixels, without_background
from polarnet.stokes import parse_mosaic

MOSAIC = parse_mosaic("90 45 / 135 0")


def test_an_event_stays_if_one_of_its_8_neighbours_fired_within_the_time(make_events):
    events = make_events(
        [(0, 1, 1, 1), (100, 1, 1, 1), (200, 2, 2, -1), (300, 4, 2, 1), (1200, 1, 2, 1), (1201, 0, 0, 1)], 4, 6
    )
    remaining = without_background(events, 1000)
    assert remaining.t.tolist() == [200, 1200]  # (1, 1) has no neighbour before it, (4, 2) is two pixels from (2, 2)
    assert without_background(events, 1101).t.tolist() == [200, 1200, 1201]


def test_a_recording_in_pieces_is_cleaned_as_a_whole(make_random_events):
    channels = [make_random_events(seed, 3000, 10**6, 20, 30) for seed in range(4)]
    cleaning = Cleaning(None, 4.0, 20_000)
    whole, pieces = Cleaner(cleaning, None), Cleaner(cleaning, None)
    together = whole(channels, 10**6)
    edges = [0, 333_333, 700_000, 10**6 + 1]
    parts = [
        Piece([slice_time(events, start, stop) for events in channels], stop, 0.0)
        for start, stop in itertools.pairwise(edges)
    ]
    joined = [*pieces.live(parts)]
    for k, events in enumerate(together):
        assert torch.equal(torch.cat([piece.channels[k].t for piece in joined]), events.t)
    assert pieces.removed == whole.removed
    assert 0 < whole.removed["background activity"] < 12_000


def test_listed_hot_pixels_of_a_mosaic_are_those_of_the_sensor(make_events, tmp_path):
    (tmp_path / "hot.txt").write_text("# x y\n3 2\n\n0, 1\n")
    channel = make_events([(0, 1, 1, 1), (1, 0, 0, 1)], 3, 4)
    cleaner = Cleaner(Cleaning(str(tmp_path / "hot.txt"), 4.0, None), MOSAIC)
    i0, i45, i90, i135 = cleaner([channel] * 4, 10)
    assert i45.t.tolist() == [1]  # 3 2 is the pixel behind 45 degrees of the cell in column 1, row 1
    assert i135.t.tolist() == [0]  # 0 1 is the pixel behind 135 degrees of the cell in column 0, row 0
    assert i0.t.tolist() == i90.t.tolist() == [0, 1]
    assert cleaner.sentence() == "2 events of 2 hot pixels, 0 events of background activity"


def test_found_hot_pixels_are_removed_from_their_channel_alone(make_random_events):
    quiet = make_random_events(1, 400, 10**6, 12, 16)
    t = torch.arange(0, 10**6, 1000)
    spot = torch.full_like(t, 5).short()
    hot = merge([quiet, select(quiet.__class__(t, spot, spot, torch.ones_like(t).to(torch.int8), 12, 16), slice(None))])
    cleaner = Cleaner(Cleaning("found", 4.0, None), None)
    first, second, *_ = cleaner([hot, quiet, quiet, quiet], 10**6)
    assert not ((first.x == 5) & (first.y == 5)).any()
    assert torch.equal(second.t, quiet.t)
    assert cleaner.hot == 1
    with pytest.raises(ValueError, match="expected a file of hot pixels for live input"):
        next(Cleaner(Cleaning("found", 4.0, None), None).live([]))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1", "line 2: expected `x y`"),
        ("1 2 3", "line 2: expected `x y`"),
        ("4 0", "line 2: pixel 4 0 is not on the sensor"),
    ],
)
def test_other_lines_of_hot_pixels_are_refused(tmp_path, line, message):
    (tmp_path / "hot.txt").write_text(f"0 0\n{line}\n")
    with pytest.raises(ValueError, match=message):
        read_hot_pixels(tmp_path / "hot.txt", 3, 4)
    assert np.array_equal(read_hot_pixels(_written(tmp_path, "3 2"), 3, 4), np.arange(12).reshape(3, 4) == 11)


def _written(folder, text):
    (folder / "one.txt").write_text(text)
    return folder / "one.txt"
