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


REPAIRED = {
    "cut within the last line": (lambda r: [*r[:-1], r[-1][:3]], "", 1999, {"cut_tail": 1}),
    "a flipped bit in a digit": (lambda r: changed(r, 700, 0, "1p"), "\n", 1999, {"unreadable_lines": 1}),
    "a flipped bit in a comma": (
        lambda r: [*r[:700], [*r[700][:3], "".join(r[700][3:])], *r[701:]],
        "\n",
        1999,
        {"unreadable_lines": 1},
    ),
    "lines of a log among the events": (
        lambda r: [*r[:9], ["usb", " dropped a packet"], *r[9:]],
        "\n",
        2000,
        {"unreadable_lines": 1},
    ),
    "a time larger than 64 bits": (lambda r: changed(r, 700, 4, "9" * 20), "\n", 1999, {"unreadable_lines": 1}),
}


@pytest.mark.parametrize("kind", REPAIRED)
def test_repaired_and_counted(csv, tmp_path, kind):
    damage, end, events, repairs = REPAIRED[kind]
    recording = read_recording(write(tmp_path / "e.csv", damage(csv), end))
    assert (len(recording.events), recording.repairs) == (events, repairs)
    assert (torch.diff(recording.events.t) >= 0).all()


REFUSED = {
    "empty": (lambda r: [], "", "of none of the formats|the file is empty"),
    "of another mode": (lambda r: [row[:2] + row[4:] for row in r], "\n", "Event Off-Pixel Timestamp have no polarity"),
    "with a column too many": (lambda r: [[*row, "7"] for row in r], "\n", "of none of the formats"),
    "with rows and columns exchanged": (
        lambda r: [[row[1], row[0], *row[2:]] for row in r],
        "\n",
        r"\d+ among the first 2000 events: events that are not on the sensor",
    ),
    "whose clock was set anew": (
        lambda r: [*r[1000:], *r[:1000]],
        "\n",
        "after event 1000, time goes back by .* us, and stays there",
    ),
    "with a tenth of its lines unreadable": (
        lambda r: [["?", *row[1:]] if i % 10 == 5 else row for i, row in enumerate(r)],
        "\n",
        "200 among the first 1800 events: lines that are not the numbers",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_refused_with_the_reason(csv, tmp_path, kind):
    damage, end, message = REFUSED[kind]
    with pytest.raises(RecordingError, match=rf"e\.csv: .*({message})"):
        read_recording(write(tmp_path / "e.csv", damage(csv), end))


@pytest.fixture
def bin_file(tmp_path, make_random_events):
    """A BIN file of two packages."""
    events = make_random_events(6, 60_000, 1_000_000)
    written = write_celex5_bin(tmp_path / "e.bin", events)
    content = (tmp_path / "e.bin").read_bytes()
    assert len(content) == 12 + 2 * (4 + 357_001)
    return tmp_path / "e.bin", bytearray(content), written


def test_a_bin_file_that_ends_within_a_package_keeps_those_before(bin_file):
    path, content, written = bin_file
    path.write_bytes(content[:-100])
    recording = read_recording(path)
    assert recording.repairs["cut_tail"] == 1
    assert torch.equal(recording.events.t, written.t[: len(recording.events)])
    assert 0 < len(recording.events) < len(written)


def test_a_flipped_bit_in_a_bin_file_costs_an_event_or_two(bin_file):
    path, content, written = bin_file
    content[5000] ^= 16
    path.write_bytes(content)
    recording = read_recording(path)
    assert abs(len(recording.events) - len(written)) <= 2


def test_a_destroyed_length_in_a_bin_file_is_refused_with_its_place(bin_file):
    path, content, _ = bin_file
    content[12 + 357_005 : 12 + 357_009] = struct.pack("<I", 2**31)
    path.write_bytes(content)
    with pytest.raises(
        RecordingError, match=r"e\.bin: package 1 before byte 357021 states a length of 2147483648 bytes"
    ):
        read_recording(path)
