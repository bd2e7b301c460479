"""Inspection, and hot pixels and background activity: found, named and removed."""

import itertools

import cv2
import numpy as np
import pytest
import torch

from polarnet.cli import main
from polarnet.events.stream import merge, slice_time
from polarnet.recordings.arrangements import Piece
from polarnet.recordings.inspection import findings, inspect_recording
from polarnet.recordings.noise import Cleaner, Cleaning, hot_pixels, never, read_hot_pixels, without_background
from polarnet.recordings.recording import open_recording
from polarnet.recordings.source import RecordingError
from polarnet.stokes import parse_mosaic
from studies.recording_files import FILES


def test_the_picture_is_of_the_events_that_took_the_least_time_and_of_no_huge_sensor(tmp_path, columns):
    """On 20 x 10 pixels it shows 30 events: here those of the second 3 ms, all at one pixel."""
    slow = [(1000 * k, k % 20, 2, 1) for k in range(30)]
    quick = [(50_000 + 100 * k, 5, 7, -1) for k in range(30)]
    later = [(100_000 + 1000 * k, k % 20, 3, 1) for k in range(30)]
    path = tmp_path / "e.txt"
    path.write_text("20 10\n" + "".join(f"{t} {x} {y} {p}\n" for t, x, y, p in slow + quick + later))
    inspection = inspect_recording(open_recording(path))
    assert columns(inspection.busiest) == [[t for t, *_ in quick], [5] * 30, [7] * 30, [-1] * 30]
    assert "busiest     30 events in 2.9 ms from 50,000 us, 10.34 kev/s" in [*findings(inspection)]
    (tmp_path / "e.txt").write_text("32767 32767\n1 2 3 1\n")
    with pytest.raises(RecordingError, match="expected a sensor of at most 16,777,216 pixels, got 32767x32767"):
        inspect_recording(open_recording(tmp_path / "e.txt"))


def test_findings_say_what_was_repaired_the_empty_rows_and_the_longest_silence(tmp_path):
    (tmp_path / "e.txt").write_text("20 10\n5 2 3 1\n4 2 3 0\n6 2 x 1\n3000000 4 5 1\n")
    lines = "\n".join(findings(inspect_recording(open_recording(tmp_path / "e.txt"))))
    for words in (
        "format      text: lines `t x y p`",
        "sensor      10 x 20 px (height x width)",
        "events      3: 2 ON, 1 OFF",
        "time        4 to 3,000,000 us, 2.999996 s",
        "time jumps  1 pauses of a second or more",
        "repaired    1 events a little earlier than the one before: put in order",
        "repaired    1 lines that are not the numbers",
    ):
        assert words in lines
    times = [100 * k + (40_000 if k >= 3000 else 0) for k in range(6000)]
    rows = [0, 1, 2, 5, 7]
    lines = "".join(f"{t} {k % 20} {rows[k % 5]} 1\n" for k, t in enumerate(times))
    (tmp_path / "e.txt").write_text("20 8\n" + lines)
    lines = [*findings(inspect_recording(open_recording(tmp_path / "e.txt")))]
    assert "empty rows  3 of 8 without any event" in lines
    assert "gap         at most 40,100 us without events from 299,900 us" in lines


def test_inspect_prints_findings_and_draws_no_hot_pixels(tmp_path, make_events, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    edge = make_events([(k, k % 50, 20, 1 - 2 * (k % 2)) for k in range(100)], 800, 1280)
    hot = make_events([(k, 700, 300, 1) for k in range(100)], 800, 1280)
    FILES["celex5_csv"][1](tmp_path / "capture.csv", merge([edge, hot]))
    assert main(["inspect", "capture.csv"]) == 0
    printed = capsys.readouterr().out
    assert "hot pixels  1 with 50.0% of the events (x 700 y 300: 100)" in printed
    picture = cv2.imread(str(tmp_path / "outputs" / "inspect" / "capture.csv.png"))
    assert picture.shape == (800, 1280, 3)
    coloured = np.argwhere((picture != 255).any(axis=-1))
    assert np.unique(coloured[:, 0]).tolist() == [20]


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
    whole, pieces = (Cleaner(Cleaning(None, 20_000), None) for _ in range(2))
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
    cleaner = Cleaner(Cleaning(str(tmp_path / "hot.txt"), None), parse_mosaic("90 45 / 135 0"))
    (piece,) = cleaner.clean([Piece([channel] * 4, 10, 0.0)])
    i0, i45, i90, i135 = piece.channels
    assert i45.t.tolist() == [1]  # 3 2 is the pixel behind 45 degrees of the cell in column 1, row 1
    assert i135.t.tolist() == [0]  # 0 1 is the pixel behind 135 degrees of the cell in column 0, row 0
    assert i0.t.tolist() == i90.t.tolist() == [0, 1]
    assert cleaner.sentence() == "2 events of 2 hot pixels"


def test_found_hot_pixels_are_removed_from_their_channel_alone(make_random_events, make_events):
    quiet = make_random_events(1, 400, 10**6, 12, 16)
    hot = merge([quiet, make_events([(t, 5, 5, 1) for t in range(0, 10**6, 1000)], 12, 16)])
    cleaner = Cleaner(Cleaning("found", None), None)
    channels, ends = [hot, quiet, quiet, quiet], [0, 250_000, 10**6]
    parts = [Piece([slice_time(e, *span) for e in channels], span[1], 0.0) for span in itertools.pairwise(ends)]
    first, second, *_ = zip(*(piece.channels for piece in cleaner.clean(parts)), strict=True)
    assert not any(((part.x == 5) & (part.y == 5)).any() for part in first)
    assert sum(map(len, second)) == len(quiet)
    assert cleaner.hot == 1
    with pytest.raises(ValueError, match="expected a file of hot pixels for live input"):
        Cleaner(Cleaning("found", None), None).clean([], live=True)


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
