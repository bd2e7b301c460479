import struct

import numpy as np
import pytest
from event_fixtures import equal

from polarnet.recordings.formats.celex5 import celex5_pictures
from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from studies.celex5_writer import write_celex5_bin, write_celex5_pictures


def header(data_type=0, loop_a=2, event_format=1, packages=1):
    return struct.pack("<8BI", data_type, loop_a, 255, 255, event_format, 0, 0, 0, packages)


def package(content, last=1):
    return struct.pack("<I", len(content) + 1) + content + bytes([last])


def write(path, rows):
    path.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


def test_what_is_written_reads_back_equal(tmp_path, make_random_events):
    events = make_random_events(2, 5000, 9_000_000)
    written = write_celex5_bin(tmp_path / "e.bin", events)
    recording = read_recording(tmp_path / "e.bin")
    assert recording.format == "celex5_bin"
    assert equal(recording.events, written)
    assert (recording.events.t[-5000:] - events.t).abs().max() <= 10  # a step of the clock
    for name in "xyp":
        assert (getattr(written, name)[-5000:] == getattr(events, name)).all()


def test_an_event_in_bytes_worked_out_by_hand(tmp_path, read):
    """Row 5 at time stamp 3, then column 9 with intensity 1000 (stored as 3095).

    Item 1: 5 << 18 | 3 << 2 | 2, as 14 bit words 0b1110 and 0b1010000. Item 2: 3095 << 16 | 9 << 5 | 1, as 0b100100001
    and 0b11000001011100.
    """
    words = [0b1110, 0b1010000, 0b100100001, 0b11000001011100]
    high = bytes(word >> 6 for word in words)
    low = sum((word & 63) << 6 * k for k, word in enumerate(words)).to_bytes(3, "little")
    (tmp_path / "e.bin").write_bytes(header() + package(high + low))
    assert read(tmp_path / "e.bin")[1] == [[0], [9], [5], [1]]


def test_polarity_is_the_sign_of_the_change_and_the_first_compares_with_zero(tmp_path, make_events, read):
    written = write_celex5_bin(
        tmp_path / "e.bin", make_events([(0, 1, 1, -1), (2048, 1, 1, -1), (4096, 1, 1, 1)], 800, 1280)
    )
    assert [written.t.tolist(), written.p.tolist()] == [[0, 0, 2048, 4096], [1, -1, -1, 1]]
    assert read(tmp_path / "e.bin")[1][3] == [1, -1, -1, 1]


def test_pictures_read_back_equal_but_for_the_pixel_that_holds_the_mode(tmp_path):
    generator = np.random.default_rng(0)
    pictures = [generator.integers(0, 4096, (800, 1280)).astype(np.uint16) for _ in range(2)]
    write_celex5_pictures(tmp_path / "p.bin", pictures, [1_000_500, 1_033_500])
    read = list(celex5_pictures(tmp_path / "p.bin"))
    assert [picture.t_us for picture in read] == [1_000_500, 1_033_500]
    for before, after in zip(pictures, read, strict=True):
        assert np.flatnonzero(before != after.intensity).tolist() in ([], [0])
    assert len(read_recording(tmp_path / "p.bin").events) == 0
    (tmp_path / "p.bin").write_bytes(header(loop_a=3) + package(bytes(300), last=0))
    with pytest.raises(RecordingError, match="expected 1536001 bytes of a full picture, got 301"):
        list(celex5_pictures(tmp_path / "p.bin"))


def test_the_end_of_a_bin_file_that_is_cut_is_left_out(tmp_path, make_random_events):
    path = tmp_path / "e.bin"
    written = write_celex5_bin(path, make_random_events(6, 60_000, 1_000_000))
    path.write_bytes(path.read_bytes()[:-100])  # of the second of two packages
    recording = read_recording(path)
    assert recording.repairs["cut_tail"] == 1
    assert recording.events.t.tolist() == written.t[: len(recording.events)].tolist()
    assert 0 < len(recording.events) < len(written)


def test_imu_samples_after_a_package_are_passed_over(tmp_path, make_events, read):
    write_celex5_bin(tmp_path / "e.bin", make_events([(0, 1, 1, 1), (1024, 1, 1, 1)], 800, 1280))
    content = (tmp_path / "e.bin").read_bytes()[12:]
    imu = struct.pack("<qI", 123_456, 2) + bytes(64)
    (tmp_path / "imu.bin").write_bytes(header(data_type=2) + content + imu + content + imu)
    restarted = 65536 * 1024 // 100  # its time stamps begin again, which a reader takes for a turn of 16 bits
    assert read(tmp_path / "imu.bin")[1][0] == [0, 1024, restarted, restarted + 1024]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (header()[:8], "expected the 12 bytes of a BIN header of a CeleX-5"),
        (header(event_format=0) + package(bytes(7)), "got mode Event Intensity, event format 0; .*wrong intensities"),
        (header(data_type=1) + package(bytes(7)), "got a loop from mode Event Intensity, .*times stand still"),
        (header(loop_a=1) + package(bytes(7)), "Event In-Pixel Timestamp, event format 1; other modes .* no"),
        (header(loop_a=0, event_format=2) + package(bytes(7)), "Event Off-Pixel Timestamp, event format 2"),
        (header() + struct.pack("<I", 2**31) + bytes(70), "package 0 before byte 16 states a length of 2147483648"),
        (header() + package(bytes(70))[:40], "no event can be read in it: {'cut_tail': 1}"),
        (
            struct.pack("<8BI", 9, 9, 9, 9, 9, 99, 99, 99, 0) + package(bytes(7)),
            "expected the 12 bytes of a BIN header",
        ),
    ],
)
def test_bin_files_that_cannot_be_events_are_refused_with_the_reason(tmp_path, content, message):
    (tmp_path / "e.bin").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"e\.bin: .*{message}"):
        read_recording(tmp_path / "e.bin", "celex5_bin")


def test_csv_events_without_change_are_dropped(tmp_path, read):
    rows = [(10, 20, 2000, 1, 5), (10, 21, 1999, -1, 7), (799, 1279, 4095, 1, 9), (1, 1, 7, 0, 10), (1, 1, 7, 0, 11)]
    _, columns, repairs = read(write(tmp_path / "e.csv", rows))
    assert (columns[0], columns[3], repairs) == ([5, 7, 9], [1, -1, 1], {"no_change": 2})


@pytest.mark.parametrize("columns", [3, 4, 6])
def test_csv_of_other_modes_is_refused_with_the_reason(tmp_path, columns):
    path = write(tmp_path / "e.csv", [(10, 20, 5, 900, 7, 8)[:columns]])
    with pytest.raises(RecordingError, match=rf"e\.csv: .*got {columns}; its other modes, of 3 or 4 columns, have no"):
        read_recording(path, "celex5_csv")
