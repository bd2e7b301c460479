"""Four files, or one mosaic, as four channels."""

import pytest
import torch

from polarnet.recordings.arrangements import read_four, read_mosaic
from polarnet.recordings.source import RecordingError
from polarnet.stokes import parse_mosaic
from studies.celex5_writer import write_celex5_csv

ANGLES = (0, 45, 90, 135)


def test_four_files_in_any_order_become_the_channels_0_45_90_135(tmp_path, make_random_events):
    events = {angle: make_random_events(angle, 200, 60_000) for angle in (90, 0, 135, 45)}
    files = {angle: tmp_path / f"camera_{k}.csv" for k, angle in enumerate(events)}
    for angle, path in files.items():
        write_celex5_csv(path, events[angle])
    first = min(int(e.t[0]) for e in events.values())
    channels = read_four({-45 if angle == 135 else angle: path for angle, path in files.items()})
    for angle, channel in zip(ANGLES, channels, strict=True):
        assert torch.equal(channel.t, events[angle].t - first)
        assert torch.equal(channel.x, events[angle].x)


def test_an_angle_that_is_missing_or_twice_there_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"one file for each of 0, 45, 90 and 135 degrees, got \[0, 45, 90\]"):
        read_four(dict.fromkeys((0, 45, 90), tmp_path / "a"))
    with pytest.raises(RecordingError, match=r"got \[0, 45, 90, 135, 180\]"):
        read_four(dict.fromkeys((0, 45, 90, 135, 180), tmp_path / "a"))


def test_a_mosaic_file_starts_with_its_first_event(tmp_path, make_random_events):
    events = make_random_events(1, 200, 60_000)
    write_celex5_csv(tmp_path / "a.csv", events)
    channels = read_mosaic(tmp_path / "a.csv", parse_mosaic("90 45 / 135 0"))
    assert min(int(c.t[0]) for c in channels) == 0
    assert sum(map(len, channels)) == len(events)
