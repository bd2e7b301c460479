import gzip
from dataclasses import replace

import pytest
import torch
from event_fixtures import equal

from polarnet.recordings.arrangements import read_four, read_mosaic
from polarnet.recordings.formats import hdf5, lines, prophesee
from polarnet.recordings.recording import open_recording, read_recording
from polarnet.recordings.source import RecordingError
from polarnet.recordings.writers import write_evt3, write_hdf5, write_text
from polarnet.stokes import parse_mosaic
from studies.recording_files import FILES

SAMPLES = {
    "aedat4/tonic_sample.aedat4": ("aedat4", 111_954, 240, 320),
    "prophesee/evt2.raw": ("evt", 521_252, 480, 640),
    "prophesee/evt3_sample.raw": ("evt", 219_596, 720, 1280),
    "event_stream/dvs.es": ("event_stream", 473_225, 240, 320),
}
"""Events, height and width as the reference notes give them (EVT2: those of the sensor that its header names)."""


@pytest.mark.shared
@pytest.mark.parametrize("name", SAMPLES)
def test_a_sample_has_the_number_of_events_that_other_readers_found(shared, read, name):
    if SAMPLES[name][0] != "evt":
        pytest.importorskip("faery")
    (form, height, width), (t, *_), repairs = read(shared / "data" / "recordings" / name)
    assert ((form, len(t), height, width), repairs) == (SAMPLES[name], {})


@pytest.mark.shared
def test_a_dat_sample_is_read_once_the_size_of_the_sensor_is_given(shared):
    path = shared / "data" / "recordings" / "prophesee" / "sample_ncars.dat"
    with pytest.raises(RecordingError, match=r"sample_ncars\.dat: .*give --height and --width"):
        read_recording(path)
    recording = read_recording(path, height=240, width=304)
    assert (recording.format, len(recording.events), recording.repairs) == ("dat", 2009, {})


@pytest.mark.parametrize("size", [1, 7, 999, 1000, 10**6])
def test_chunks_hold_the_same_events_whatever_their_size(tmp_path, make_random_events, size):
    events = make_random_events(0, 1000, 10**6)
    FILES["celex5_csv"][1](tmp_path / "e.csv", events)
    chunks = list(open_recording(tmp_path / "e.csv").chunks(size))
    assert {len(chunk) for chunk in chunks[:-1]} <= {size}
    assert 0 < len(chunks[-1]) <= size
    for name in "txyp":
        assert torch.equal(torch.cat([getattr(chunk, name) for chunk in chunks]), getattr(events, name))


def test_a_recording_may_be_iterated_again_and_may_have_no_events(tmp_path, read):
    (tmp_path / "e.txt").write_text("18 12\n5 1 2 1\n4 1 2 1\n6 1 2 0\n")
    reader = open_recording(tmp_path / "e.txt")
    for _ in range(2):
        (chunk,) = reader
        assert chunk.t.tolist() == [4, 5, 6]
        assert reader.repairs["unsorted"] == 1
    (tmp_path / "e.txt").write_text("18 12\n")
    assert read(tmp_path / "e.txt") == (("text", 12, 18), [[]] * 4, {})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"\x00\x01\x02\xff" * 100, "of none of the formats e2p, esfp, metavision, monash, m3ed, mvsec, dsec, rosbag"),
        (b"Dear reader,\nthis is a letter.\n", r"of none of the formats .*, name it as `format` \(--format\)"),
        (b"1,2,3,4,5,6\n", "of none of the formats"),
    ],
)
def test_content_of_no_known_format_is_refused_by_name(tmp_path, content, message):
    (tmp_path / "what.dat").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"what\.dat: .*{message}"):
        read_recording(tmp_path / "what.dat")
    with pytest.raises(RecordingError, match="name a file in it"):
        read_recording(tmp_path)


def test_a_format_that_is_named_is_taken_without_a_look_at_the_content(tmp_path):
    (tmp_path / "e.csv").write_text("10,20,4000,1\n11,21,4001,0\n")
    assert open_recording(tmp_path / "e.csv", "text", height=4002, width=40).format == "text"
    with pytest.raises(ValueError, match=r"expected a format of e2p, .*, got 'celex'"):
        read_recording(tmp_path / "e.csv", "celex")


def test_impossible_arguments_are_refused_before_reading(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        open_recording(tmp_path / "nothing.csv")
    (tmp_path / "e.txt").write_text("5 1 2 1\n")
    for arguments, message in (
        ({"height": 0, "width": 4}, "expected a sensor with sides of 1 to 32767 px, got 0x4"),
        ({}, "give --height and --width"),
    ):
        with pytest.raises(ValueError, match=message):
            open_recording(tmp_path / "e.txt", **arguments)
    (tmp_path / "e.txt").write_text("18 12\n5 1 2 1\n")
    (tmp_path / "e.bag").write_bytes(gzip.compress(b"#ROSBAG V2.0\n"))
    with pytest.raises(RecordingError, match=r"e\.bag: expected the format rosbag outside an archive; unpack it"):
        open_recording(tmp_path / "e.bag")
    with pytest.raises(RecordingError, match="the file states a height of 12 px, 13 was given"):
        read_recording(tmp_path / "e.txt", height=13, width=18)


@pytest.mark.parametrize("name", ["a.txt", "a.txt.gz", "a.raw", "a.h5"])
def test_the_share_that_is_read_grows_to_the_whole(name, tmp_path, monkeypatch, make_random_events):
    monkeypatch.setattr(lines, "BLOCK_BYTES", 2000)
    monkeypatch.setattr(prophesee, "EVT_BLOCK_WORDS", 200)
    monkeypatch.setattr(hdf5, "BLOCK_EVENTS", 100)
    write = {".txt": write_text, ".raw": write_evt3, ".h5": write_hdf5}
    path = tmp_path / name.removesuffix(".gz")
    write[path.suffix](path, make_random_events(1, 1000, 10**6, 40, 50))
    if name.endswith(".gz"):
        path = path.rename(tmp_path / "plain")
        (tmp_path / name).write_bytes(gzip.compress(path.read_bytes()))
    reader = open_recording(tmp_path / name)
    shares = [reader.repairs.share_read for _ in reader.chunks(10)]
    assert shares == sorted(shares)
    assert 0 < shares[0] < 0.5 or name.endswith(".gz")
    assert 0.8 < shares[-1] <= 1


@pytest.mark.parametrize("kind", [kind for kind in FILES if kind != "celex5_bin"])
def test_a_file_of_each_kind_has_the_events_that_were_written(kind, tmp_path, make_random_events):
    suffix, write = FILES[kind]
    events = make_random_events(1, 30_000, 10**6, 260, 346)
    events = replace(events, height=800, width=1280) if kind == "celex5_csv" else events
    events = replace(events, t=events.t - events.t[0]) if kind == "event_stream" else events  # as faery writes them
    write(tmp_path / f"e{suffix}", events)
    part = {"m3ed": "left", "mvsec": "left"}.get(kind)
    recording = read_recording(tmp_path / f"e{suffix}", part=part)
    assert (kind.split()[0].rstrip(","), recording.repairs) == (recording.format, {})
    assert equal(recording.events, events)


ANGLES = (0, 45, 90, 135)


def test_four_files_in_any_order_or_one_mosaic_become_the_four_channels(tmp_path, make_random_events):
    events = {angle: make_random_events(angle, 200, 60_000) for angle in (90, 0, 135, 45)}
    files = {angle: tmp_path / f"camera_{k}.csv" for k, angle in enumerate(events)}
    for angle, path in files.items():
        FILES["celex5_csv"][1](path, events[angle])
    first = min(int(e.t[0]) for e in events.values())
    channels = read_four({-45 if angle == 135 else angle: path for angle, path in files.items()})
    for angle, channel in zip(ANGLES, channels, strict=True):
        assert torch.equal(channel.t, events[angle].t - first)
        assert torch.equal(channel.x, events[angle].x)
    events = make_random_events(1, 200, 60_000)
    FILES["celex5_csv"][1](tmp_path / "a.csv", events)
    channels = read_mosaic(tmp_path / "a.csv", parse_mosaic("90 45 / 135 0"))
    assert min(int(c.t[0]) for c in channels) == 0
    assert sum(map(len, channels)) == len(events)


def test_an_angle_that_is_missing_or_twice_there_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"one file for each of 0, 45, 90 and 135 degrees, got \[0, 45, 90\]"):
        read_four(dict.fromkeys((0, 45, 90), tmp_path / "a"))
    with pytest.raises(RecordingError, match=r"got \[0, 45, 90, 135, 180\]"):
        read_four(dict.fromkeys((0, 45, 90, 135, 180), tmp_path / "a"))
