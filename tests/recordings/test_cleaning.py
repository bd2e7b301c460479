"""Hot pixels and background activity: found and removed."""

import itertools

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events, merge, slice_time
from polarnet.recordings.arrangements import Piece
from polarnet.recordings.noise import (
    Cleaner,
    Cleaning,
    event_counts,
    hot_pixels,
    never,
    read_hot_pixels,
    without_background,
    without_pixels,
)
from polarnet.stokes import parse_mosaic


def test_a_pixel_that_fires_much_more_than_those_around_it_is_hot_and_an_edge_is_not():
    """Events all over the sensor, more of them in its right half, for a second."""
    generator = np.random.default_rng(0)
    counts = np.full((20, 30), 20)
    counts[:, 15:] *= 5
    counts[3, 4] = 900
    y, x = (np.repeat(axis.ravel(), counts.ravel()) for axis in np.indices(counts.shape))
    t = np.sort(generator.integers(0, 1_000_000, len(x)))
    order = generator.permutation(len(x))
    events = Events.from_columns(t, x[order], y[order], generator.choice([-1, 1], len(x)), 20, 30)
    assert np.array_equal(event_counts(events), counts)
    hot = hot_pixels(event_counts(events), 1.0, 5)
    assert np.argwhere(hot).tolist() == [[3, 4]]
    clean = without_pixels(events, hot)
    assert (len(clean), event_counts(clean)[3, 4]) == (len(events) - 900, 0)
    assert (clean.t.diff() >= 0).all()


def test_one_factor_more_than_the_third_busiest_around_is_hot_and_thin_lines_are_not():
    counts = np.ones((40, 60), np.int64)
    counts[10:13] = 50  # an edge that passes
    counts[25, 5:30] = 50  # a line of one pixel
    counts[34, 20] = 100
    counts[34, 40:42] = 100  # two neighbours
    assert np.argwhere(hot_pixels(counts, 1.0, 5)).tolist() == [[34, 20], [34, 40], [34, 41]]


@pytest.mark.parametrize(("count", "duration_s", "hot"), [(7, 1e-6, False), (8, 1e-6, True), (8, 1.0, False)])
def test_a_few_events_in_no_time_are_not_hot(count, duration_s, hot):
    counts = np.zeros((8, 8), np.int64)
    counts[3, 4] = count
    assert hot_pixels(counts, duration_s, 4).any() == hot


def test_an_event_stays_if_one_of_its_8_neighbours_fired_within_the_time(make_events):
    events = make_events(
        [(0, 1, 1, 1), (100, 1, 1, 1), (200, 2, 2, -1), (300, 4, 2, 1), (1200, 1, 2, 1), (1201, 0, 0, 1)], 4, 6
    )
    # (1, 1) has no neighbour before it, (4, 2) is two pixels from (2, 2)
    assert without_background(events, 1000, never(events)).t.tolist() == [200, 1200]
    assert without_background(events, 1101, never(events)).t.tolist() == [200, 1200, 1201]


def test_a_recording_in_pieces_is_cleaned_as_a_whole(make_random_events):
    channels = [make_random_events(seed, 3000, 10**6, 20, 30) for seed in range(4)]
    whole, pieces = (Cleaner(Cleaning(None, 4.0, 20_000), None) for _ in range(2))
    (together,) = whole.clean([Piece(channels, 10**6, 0.0)])
    parts = [
        Piece([slice_time(events, start, stop) for events in channels], stop, 0.0)
        for start, stop in itertools.pairwise([0, 333_333, 700_000, 10**6 + 1])
    ]
    joined = [*pieces.clean(parts, live=True)]
    for k, events in enumerate(together.channels):
        assert torch.equal(torch.cat([piece.channels[k].t for piece in joined]), events.t)
    assert pieces.removed == whole.removed
    assert 0 < whole.removed["background activity"] < 12_000


def test_listed_hot_pixels_of_a_mosaic_are_those_of_the_sensor(make_events, tmp_path):
    (tmp_path / "hot.txt").write_text("# x y\n3 2\n\n0, 1\n")
    channel = make_events([(0, 1, 1, 1), (1, 0, 0, 1)], 3, 4)
    cleaner = Cleaner(Cleaning(str(tmp_path / "hot.txt"), 4.0, None), parse_mosaic("90 45 / 135 0"))
    (piece,) = cleaner.clean([Piece([channel] * 4, 10, 0.0)])
    i0, i45, i90, i135 = piece.channels
    assert i45.t.tolist() == [1]  # 3 2 is the pixel behind 45 degrees of the cell in column 1, row 1
    assert i135.t.tolist() == [0]  # 0 1 is the pixel behind 135 degrees of the cell in column 0, row 0
    assert i0.t.tolist() == i90.t.tolist() == [0, 1]
    assert cleaner.sentence() == "2 events of 2 hot pixels, 0 events of background activity"


def test_found_hot_pixels_are_removed_from_their_channel_alone(make_random_events, make_events):
    quiet = make_random_events(1, 400, 10**6, 12, 16)
    hot = merge([quiet, make_events([(t, 5, 5, 1) for t in range(0, 10**6, 1000)], 12, 16)])
    cleaner = Cleaner(Cleaning("found", 4.0, None), None)
    channels, ends = [hot, quiet, quiet, quiet], [0, 250_000, 10**6]
    parts = [Piece([slice_time(e, *span) for e in channels], span[1], 0.0) for span in itertools.pairwise(ends)]
    first, second, *_ = zip(*(piece.channels for piece in cleaner.clean(parts)), strict=True)
    assert not any(((part.x == 5) & (part.y == 5)).any() for part in first)
    assert sum(map(len, second)) == len(quiet)
    assert cleaner.hot == 1
    with pytest.raises(ValueError, match="expected a file of hot pixels for live input"):
        Cleaner(Cleaning("found", 4.0, None), None).clean([], live=True)


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
