"""Kinds of damage that recordings meet, on a sound file: what is repaired and how often, and what is refused."""

import struct

import pytest
import torch

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from studies.celex5_writer import write_celex5_bin, write_celex5_csv

EVENTS = 2000


@pytest.fixture
def csv(tmp_path, make_random_events):
    """Rows of row, column, intensity, polarity, t of 2000 events in a second, and what writes them."""
    write_celex5_csv(tmp_path / "sound.csv", make_random_events(5, EVENTS, 1_000_000))
    return [line.split(",") for line in (tmp_path / "sound.csv").read_text().splitlines()]


def write(path, rows, end="\n"):
    path.write_text("\n".join(",".join(row) for row in rows) + end)
    return path


def changed(rows, number, column, value):
    rows = [list(row) for row in rows]
    rows[number][column] = value
    return rows


@pytest.mark.parametrize(
    ("damage", "end", "events", "repairs"),
    [
        (lambda r: [*r[:-1], r[-1][:3]], "", 1999, {"cut_tail": 1}),
        (lambda r: changed(r, 700, 0, "1p"), "\n", 1999, {"unreadable_lines": 1}),
        (lambda r: [*r[:9], ["usb", " dropped a packet"], *r[9:]], "\n", 2000, {"unreadable_lines": 1}),
        (lambda r: changed(r, 700, 4, "9" * 20), "\n", 1999, {"unreadable_lines": 1}),
    ],
    ids=["cut within the last line", "flipped bit in a digit", "lines of a log", "time larger than 64 bits"],
)
def test_repaired_and_counted(csv, tmp_path, damage, end, events, repairs):
    recording = read_recording(write(tmp_path / "e.csv", damage(csv), end))
    assert (len(recording.events), recording.repairs) == (events, repairs)
    assert (torch.diff(recording.events.t) >= 0).all()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: [[*row, "7"] for row in r], "of none of the formats"),
        (
            lambda r: [[row[1], row[0], *row[2:]] for row in r],
            r"\d+ among the first 2000 events: events that are not on the sensor",
        ),
        (lambda r: [*r[1000:], *r[:1000]], "after event 1000, time goes back by .* us, and stays there"),
        (
            lambda r: [["?", *row[1:]] if i % 10 == 5 else row for i, row in enumerate(r)],
            "200 among the first 1800 events: lines that are not the numbers",
        ),
    ],
    ids=["a column too many", "rows and columns exchanged", "clock set anew", "a tenth of the lines unreadable"],
)
def test_refused_with_the_reason(csv, tmp_path, damage, message):
    with pytest.raises(RecordingError, match=rf"e\.csv: .*{message}"):
        read_recording(write(tmp_path / "e.csv", damage(csv)))


def test_a_damaged_bin_file_keeps_what_is_sound_or_is_refused_with_the_place(tmp_path, make_random_events):
    """Two packages: the end cut off, a bit flipped, a length destroyed."""
    path = tmp_path / "e.bin"
    written = write_celex5_bin(path, make_random_events(6, 60_000, 1_000_000))
    sound = path.read_bytes()
    assert len(sound) == 12 + 2 * (4 + 357_001)
    path.write_bytes(sound[:-100])
    recording = read_recording(path)
    assert recording.repairs["cut_tail"] == 1
    assert torch.equal(recording.events.t, written.t[: len(recording.events)])
    assert 0 < len(recording.events) < len(written)
    path.write_bytes(sound[:5000] + bytes([sound[5000] ^ 16]) + sound[5001:])
    assert abs(len(read_recording(path).events) - len(written)) <= 2
    path.write_bytes(sound[: 12 + 357_005] + struct.pack("<I", 2**31) + sound[12 + 357_009 :])
    with pytest.raises(RecordingError, match=r"e\.bin: package 1 before byte 357021 states a length of 2147483648"):
        read_recording(path)
