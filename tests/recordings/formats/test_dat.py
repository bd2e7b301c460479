import numpy as np
import pytest

from polarnet.recordings.recording import read_recording
from polarnet.recordings.source import RecordingError

HEADER = b"% Data file containing CD events.\n% Version 2\n% Height 720\n% Width 1280\n"


def events(rows):
    return np.array([(t % 2**32, x | y << 14 | p << 28) for t, x, y, p in rows], "<u4").tobytes()


def test_version_2_has_14_bits_for_each_coordinate(tmp_path):
    content = HEADER + b"\x0c\x08" + events([(5, 1279, 0, 1), (7, 0, 719, 0)])
    (tmp_path / "e.dat").write_bytes(content)
    recording = read_recording(tmp_path / "e.dat")
    found = recording.events
    assert (recording.format, found.height, found.width, recording.repairs) == ("dat", 720, 1280, {})
    assert [found.t.tolist(), found.x.tolist(), found.y.tolist()] == [[5, 7], [1279, 0], [0, 719]]
    assert found.p.tolist() == [1, -1]


def test_version_1_has_9_and_8_bits(tmp_path):
    words = np.array([(5, 303 | 239 << 9 | 1 << 17)], "<u4").tobytes()
    (tmp_path / "e.dat").write_bytes(b"% Version 1\n\x00\x08" + words)
    found = read_recording(tmp_path / "e.dat", height=240, width=304).events
    assert [found.x.tolist(), found.y.tolist(), found.p.tolist()] == [[303], [239], [1]]


def test_times_run_on_when_32_bits_are_full(tmp_path):
    rows = [(2**32 - 5, 1, 1, 1), (2**32 - 1, 1, 1, 0), (2**32 + 3, 1, 1, 1)]
    (tmp_path / "e.dat").write_bytes(HEADER + b"\x0c\x08" + events(rows))
    assert read_recording(tmp_path / "e.dat").events.t.tolist() == [2**32 - 5, 2**32 - 1, 2**32 + 3]


def test_half_an_event_at_the_end_is_left_out_and_counted(tmp_path):
    (tmp_path / "e.dat").write_bytes(HEADER + b"\x0c\x08" + events([(5, 1, 0, 1), (7, 0, 1, 0)])[:-3])
    recording = read_recording(tmp_path / "e.dat")
    assert (len(recording.events), recording.repairs) == (1, {"cut_tail": 1})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEADER, "the file ends within its header"),
        (HEADER + b"\x0e\x08", "expected events of type 0 or 12 and 8 bytes, .* got type 14"),
        (b"% Version 7\n\x0c\x08", "expected DAT of version 1 or 2, got 7"),
    ],
)
def test_other_dat_files_are_refused_with_the_reason(tmp_path, content, message):
    (tmp_path / "e.dat").write_bytes(content)
    with pytest.raises(RecordingError, match=rf"e\.dat: .*{message}"):
        read_recording(tmp_path / "e.dat", height=720, width=1280)
