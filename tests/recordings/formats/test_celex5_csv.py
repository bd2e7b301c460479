import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError
from studies.celex5_writer import write_celex5_csv

INTENSITY_MODE = [(10, 20, 2000, 1, 5), (10, 21, 1999, -1, 7), (799, 1279, 4095, 1, 9)]


def write(path, rows):
    path.write_text("".join(",".join(map(str, row)) + "\n" for row in rows))
    return path


def test_what_is_written_reads_back_equal(tmp_path, make_random_events, same_events):
    events = make_random_events(1, 5000, 3_000_000)
    write_celex5_csv(tmp_path / "e_EI_.csv", events)
    recording = read_recording(tmp_path / "e_EI_.csv")
    assert recording.format == "celex5_csv"
    assert same_events(recording.events, events)
    assert recording.repairs == {}


def test_events_whose_pixel_did_not_change_are_dropped_and_counted(tmp_path):
    path = write(tmp_path / "e.csv", [*INTENSITY_MODE, (1, 1, 7, 0, 10), (1, 1, 7, 0, 11)])
    recording = read_recording(path)
    assert recording.events.t.tolist() == [5, 7, 9]
    assert recording.events.p.tolist() == [1, -1, 1]
    assert recording.repairs == {"no_change": 2}


@pytest.mark.parametrize(
    ("rows", "mode"),
    [
        ([(10, 20, 5), (11, 21, 1007)], "Event Off-Pixel Timestamp"),
        ([(10, 20, 5, 900), (11, 21, 7, 1007)], "Event In-Pixel Timestamp"),
    ],
)
def test_modes_without_polarity_are_refused_with_the_reason(tmp_path, rows, mode):
    path = write(tmp_path / "e.csv", rows)
    with pytest.raises(RecordingError, match=rf"e\.csv: .* mode {mode} have no polarity"):
        read_recording(path)


def test_other_columns_are_refused_with_those_of_every_mode(tmp_path):
    path = write(tmp_path / "e.csv", [(1, 2, 3, 4, 5, 6)])
    with pytest.raises(RecordingError, match=r"the 5 columns row,col,adc,polarity,t .* or the 3 or 4 .* got 6"):
        read_recording(path, "celex5_csv")


def test_time_stamps_of_old_converters_become_microseconds_at_the_clock_that_is_given(tmp_path):
    path = write(tmp_path / "e.csv", [(1, 1, 7, 1, 0), (1, 1, 8, 1, 1), (1, 1, 9, 1, 100)])
    assert read_recording(path, clock_mhz=100).events.t.tolist() == [0, 10, 1024]
