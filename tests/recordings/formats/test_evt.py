import numpy as np
import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError

HEADER = {2: b"% evt 2.0\n% geometry 640x480\n", 3: b"% format EVT3;height=720;width=1280\n% end\n"}


def columns(tmp_path, version, words):
    path = tmp_path / "e.raw"
    path.write_bytes(HEADER[version] + np.array(words, {2: "<u4", 3: "<u2"}[version]).tobytes())
    recording = read_recording(path)
    assert recording.format == "evt"
    return [getattr(recording.events, name).tolist() for name in "txyp"], recording.repairs


def test_evt2_words_worked_out_by_hand(tmp_path):
    """The time is 28 high bits and 6 low ones; 0 is OFF, 1 is ON."""
    words = [
        8 << 28 | 100,
        1 << 28 | 5 << 22 | 639 << 11 | 7,
        0 << 28 | 63 << 22 | 1 << 11 | 479,
        8 << 28 | 101,
        1 << 28,
    ]
    found, repairs = columns(tmp_path, 2, words)
    assert found == [[6405, 6463, 6464], [639, 1, 0], [7, 479, 0], [1, -1, 1]]
    assert repairs == {}


def test_evt3_words_worked_out_by_hand(tmp_path):
    """The time is 12 high bits and 12 low ones; vectors of 12 and 8 pixels follow a base."""
    words = [
        0x8001,
        0x6002,
        0x0007,
        0x2000 | 5,
        0x2800 | 6,
        0x3800 | 100,
        0x4000 | 0b1001,
        0x5000 | 0b10,
        0x6003,
        0x0008,
        0x2001,
    ]
    found, repairs = columns(tmp_path, 3, words)
    assert found[0] == [4098] * 5 + [4099]
    assert found[1:] == [[5, 6, 100, 103, 113, 1], [7, 7, 7, 7, 7, 8], [-1, 1, 1, 1, 1, -1]]
    assert repairs == {}


def test_times_run_on_when_the_high_bits_are_full(tmp_path):
    found, _ = columns(tmp_path, 3, [0x8FFF, 0x6FFF, 0x0007, 0x2000, 0x8000, 0x2000])
    assert found[0] == [2**24 - 1, 2**24]
    found, _ = columns(tmp_path, 2, [8 << 28 | 2**28 - 1, 63 << 22, 8 << 28, 0])
    assert found[0] == [2**34 - 1, 2**34]


def test_events_before_the_first_time_and_row_are_left_out_and_counted(tmp_path):
    assert columns(tmp_path, 3, [0x2000, 0x8001, 0x2000, 0x0007, 0x2000])[1] == {"orphans": 2}
    assert columns(tmp_path, 2, [1 << 28, 8 << 28, 1 << 28])[1] == {"orphans": 1}


def test_the_sensors_name_stands_for_its_size(tmp_path):
    words = np.array([0x8001, 0x0007, 0x2000], "<u2").tobytes()
    (tmp_path / "e.raw").write_bytes(b"% evt 3.0\n% plugin_name hal_plugin_gen41_evk3\n" + words)
    events = read_recording(tmp_path / "e.raw").events
    assert (events.height, events.width) == (720, 1280)
    (tmp_path / "e.raw").write_bytes(b"% evt 3.0\n" + words)
    with pytest.raises(RecordingError, match="give height and width"):
        read_recording(tmp_path / "e.raw")


def test_other_versions_are_refused(tmp_path):
    (tmp_path / "e.raw").write_bytes(b"% evt 4.0\n1234")
    with pytest.raises(RecordingError, match="states EVT 2 or 3, got 4"):
        read_recording(tmp_path / "e.raw")
