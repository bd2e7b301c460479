"""Four files, or one mosaic, as the four channels of an event store."""

import numpy as np
import pytest
import torch

from polarnet.events.stream import Events
from polarnet.recordings.arrangements import read_four, read_mosaic, write_store
from polarnet.recordings.source import RecordingError
from polarnet.stokes import parse_mosaic
from polarnet.storage.events import EventStore
from studies.celex5_writer import write_celex5_csv

ANGLES = (0, 45, 90, 135)


def some_events(seed, count=200, height=800, width=1280):
    generator = np.random.default_rng(seed)
    t = np.sort(generator.integers(1000, 60_000, count))
    y, x = generator.integers(0, height, count), generator.integers(0, width, count)
    p = generator.choice([-1, 1], count)
    columns = (t, x.astype(np.int16), y.astype(np.int16), p.astype(np.int8))
    return Events(*map(torch.from_numpy, columns), height, width)


def test_four_files_in_any_order_become_the_channels_0_45_90_135(tmp_path):
    events = {angle: some_events(angle) for angle in (90, 0, 135, 45)}
    files = {angle: tmp_path / f"camera_{k}.csv" for k, angle in enumerate(events)}
    for angle, path in files.items():
        write_celex5_csv(path, events[angle])
    first = min(int(e.t[0]) for e in events.values())
    channels = read_four({-45 if angle == 135 else angle: path for angle, path in files.items()})
    for angle, channel in zip(ANGLES, channels, strict=True):
        assert torch.equal(channel.t, events[angle].t - first)
        assert torch.equal(channel.x, events[angle].x)
    starts = {0: 5000, 45: 6000, 90: 7000, 135: 8000}
    for angle, channel in zip(ANGLES, read_four(files, starts), strict=True):
        assert torch.equal(channel.t, events[angle].t[events[angle].t >= starts[angle]] - starts[angle])
    write_store(tmp_path / "events.zarr", {"a": channels})
    stored = EventStore.open(tmp_path / "events.zarr").read("a")
    assert all(torch.equal(ours.t, theirs.t) for ours, theirs in zip(stored, channels, strict=True))


def test_an_angle_that_is_missing_or_twice_there_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"one file for each of 0, 45, 90 and 135 degrees, got \[0, 45, 90\]"):
        read_four(dict.fromkeys((0, 45, 90), tmp_path / "a"))
    with pytest.raises(RecordingError, match=r"got \[0, 45, 90, 135, 180\]"):
        read_four(dict.fromkeys((0, 45, 90, 135, 180), tmp_path / "a"))
    with pytest.raises(RecordingError, match="a start for each of the angles"):
        read_four(dict.fromkeys(ANGLES, tmp_path / "a"), {0: 1})


def test_a_mosaic_file_starts_with_its_first_event(tmp_path):
    events = some_events(1)
    write_celex5_csv(tmp_path / "a.csv", events)
    channels = read_mosaic(tmp_path / "a.csv", parse_mosaic("90 45 / 135 0"))
    assert min(int(c.t[0]) for c in channels) == 0
    assert sum(map(len, channels)) == len(events)
